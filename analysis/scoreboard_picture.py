"""The chart of a scoreboard as one picture: error against time per frame of the same networks, scene by scene.

    python analysis/scoreboard_picture.py RUN [RUN ...] PICTURE

Each RUN is the folder of a finished study of steps, such as those of `experiments/scoreboard`.
"""

import argparse
from pathlib import Path

from cconv.report.compared_runs import compared_runs
from cconv.report.scoreboard import scores_table
from cconv.report.scoreboard_plots import scoreboard_chart
from cconv.study.records.run_folder import RunFolder


def main() -> None:
    """Draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", metavar="RUN", type=Path, nargs="+", help="run folder of a finished study")
    parser.add_argument("picture", metavar="PICTURE", type=Path, help="file to write, e.g. scoreboard.png")
    arguments = parser.parse_args()
    scores = scores_table(compared_runs([RunFolder.open(run) for run in arguments.runs]))
    scoreboard_chart(scores).savefig(arguments.picture, dpi=90)


if __name__ == "__main__":
    main()
