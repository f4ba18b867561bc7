"""Import of particle files as other programs write them: one reader a format, then fields, series of files, a plan."""
