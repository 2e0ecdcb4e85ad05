"""How a study runs: its trials on workers, their record on disk, its results with intervals, and its page."""
