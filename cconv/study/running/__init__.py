"""Running trainings: the data, the queue of trainings, the pools that run them, and the training itself."""
