"""Commands that relate the CT or mesh of a bone to views."""
