"""Decisions on a case and the plan computed from them: values with undo, and functions without state. Imports no other
part of the app."""
