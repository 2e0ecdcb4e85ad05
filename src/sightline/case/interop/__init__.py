"""Views and plans in the files of other programs: docs/interop.md has every convention and sign."""
