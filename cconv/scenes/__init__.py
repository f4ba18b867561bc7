"""Scenes: one file each, with its particles and its physics."""
