"""Draw the figures of the pages on concepts from the committed run folder: `python docs/draw_figures.py [FOLDER]`."""

import sys
from pathlib import Path

from matplotlib.figure import Figure

from cconv.report.plots import learning_curves_chart, rung_audit_chart, stability_chart
from cconv.report.speed_accuracy import speed_accuracy_chart
from cconv.report.tables import curves_table
from cconv.study.records.run_folder import RunFolder

DOCS = Path(__file__).parent
SAMPLE = DOCS.parent / "analysis" / "sample_run"


def figures(run: RunFolder) -> dict[str, Figure]:
    """Draw what each page shows of a finished run, by the name of the page."""
    summary, curves = run.summary(), curves_table(run)
    searched = curves[curves["retrained"] | curves["stage"].isin(["random", "adaptive"])]
    return {
        "asha": learning_curves_chart(searched, summary),
        "rung_audit": rung_audit_chart(summary),
        "front": speed_accuracy_chart(summary),
        "verdict": stability_chart(summary),
    }


def draw(folder: Path) -> list[Path]:
    """Write a PNG for each page and list them."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, figure in figures(RunFolder.open(SAMPLE)).items():
        written.append(folder / f"{name}.png")
        figure.savefig(written[-1], dpi=90, metadata={"Software": None})
    return written


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else DOCS / "figures")
