"""How a study runs: its trials on workers, their record, estimates with intervals, plots and the page."""
