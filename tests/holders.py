"""Models whose predictions hold a known amount of memory, importable by the processes that measure it."""

import torch

MEGABYTE = 2**18  # float32 values


class Holder:
    """Stands for a model whose predictions hold so many megabytes."""

    def __init__(self, megabytes):
        self.megabytes = megabytes

    def predict_frame(self, frame, scene):
        """Fill memory, so that it is resident."""
        return torch.ones(self.megabytes * MEGABYTE)


def load_holder(path):
    """A `Holder` of as many megabytes as the folder is named."""
    return Holder(int(path.name))
