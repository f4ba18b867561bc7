"""Study files for tests that run them."""

from pathlib import Path

SMOKE_SPACE = Path(__file__).parents[1] / "search_spaces" / "smoke.toml"

SEARCH = """
name = "{name}"
task = "density_gradient"

[network]
layers = 2
first_channels = 4
hidden_channels = 8

[training]
updates = 36
evaluate_every = 4

[search]
space = "{space}"
grace_updates = 4
concurrency = {concurrency}

[stages.random]
trials = {random}

[stages.adaptive]
trials = {adaptive}
"""


def write_search(folder: Path, name: str, *, concurrency: int, random: int, adaptive: int) -> Path:
    """A study of two searches, seconds long, that nothing else reads."""
    path = folder / f"{name}.toml"
    settings = {"concurrency": concurrency, "random": random, "adaptive": adaptive}
    path.write_text(SEARCH.format(name=name, space=SMOKE_SPACE, **settings))
    return path
