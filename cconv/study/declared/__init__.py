"""What a user writes: study files and search spaces."""
