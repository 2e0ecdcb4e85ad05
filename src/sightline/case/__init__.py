"""From image files to a plan and its report, and the journal that records every step.

A module or sub-room may import those above it in this table; those in the last row do not import each other.

| name | what it holds |
|---|---|
| `canonical` | canonical JSON and its SHA-256 |
| `journal` | the folder of a case: entries, hash chain, original files |
| `views` | from two files to two calibrated views |
| `contents` | the content of each kind of entry |
| `stages` | records each stage of a procedure as an entry; the newest images of a case |
| `replay` | recomputes a case and compares it with its entries |
| `acquire`, `deidentify`, `interop`, `report`, `watch` | see their own docstrings |
"""
