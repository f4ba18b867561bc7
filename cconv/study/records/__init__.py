"""The records of a study on disk."""
