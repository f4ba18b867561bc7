"""Statistics over records; nothing here trains, and nothing loads torch or Ray."""
