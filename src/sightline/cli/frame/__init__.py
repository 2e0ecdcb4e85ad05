"""Commands that make, measure, draw and check frames."""
