"""Rollouts: a model's answers turned into the next frame, again and again."""
