"""From files to a plan and its report."""
