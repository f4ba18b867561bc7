"""Statistics over records. No file here trains a model or loads torch or Ray."""
