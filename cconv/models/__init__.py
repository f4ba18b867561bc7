"""Models: a network with its task, standardisation and units, on disk and by least squares."""
