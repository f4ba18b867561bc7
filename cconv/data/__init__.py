"""Particle data: readers, splits, generation, targets and features."""
