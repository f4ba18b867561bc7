"""The section on rollouts over whole test trajectories: how long the finalists stay near the stored frames."""

from typing import Any

from cconv.report.rollout_plots import beyond_table, distributions_chart, energy_chart, rollout_errors_chart
from cconv.report.sections.section import Records, Section
from cconv.study.records.rollouts import FOLDER, FRAMES, read_rollouts
from cconv.study.records.summary import Summary


class RolloutsSection(Section):
    """Show errors, energies and distributions of rollouts beside the stored ones, and an animation."""

    name = "rollouts"
    title = "Rollouts"
    part = "rolled"

    def draw(self, summary: Summary, records: Records) -> dict[str, Any]:
        """Draw the charts of all finalists, and the animation of the recommended one if its frames are there."""
        from cconv.report.rollout_animation import animated  # takes torch, which takes seconds

        rollouts = read_rollouts(records.run, summary.rolled)
        known: dict[str, Any] = {"lost": {name: found.lost for name, found in rollouts.items() if found.lost}}
        frames = records.run.path / FOLDER / FRAMES
        known["animation"] = animated(frames) if frames.is_dir() else None
        if not any(found.rolled for found in rollouts.values()):
            return known | {"charts": None}
        charts = {
            "errors": rollout_errors_chart(rollouts),
            "energies": energy_chart(rollouts),
            "distributions": distributions_chart(rollouts),
        }
        return known | {"charts": charts, "rows": beyond_table(rollouts)}
