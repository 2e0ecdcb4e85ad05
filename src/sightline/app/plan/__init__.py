"""What people decide on a case and the plan that follows: values that can be undone, and functions without state.
Imports no other part of the app."""
