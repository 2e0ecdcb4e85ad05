"""From files to a plan and its report, and the journal of all that was done.

A module or sub-room may import those above it in this table; those of the last row do not import each other.

| name | what it holds |
|---|---|
| `canonical` | one JSON text for one value |
| `journal` | a case's folder: entries, their chain, originals |
| `views` | from two files to two calibrated views |
| `documents`, `contents` | results as JSON, and what an entry holds of them |
| `stages` | each stage of a procedure as an entry |
| `replay` | a case computed again and compared |
| `acquire`, `deidentify`, `interop`, `report`, `watch` | see each |
"""
