"""The workbench's page beside a robot that is played: its campaign goes on until STOP is clicked.

It shows what the page does with what nodes tell, without ROS; the nodes themselves are in
test_workbench_live.py.
"""

import sys
from pathlib import Path

from parallel_cal.workbench.server import serve

REASON = (
    "pose 27 of 80, chosen to tell backlash of joint 2 from its encoder's eccentricity; on the way "
    "past the play of all three joints, so that every one is approached from below"
)


class PlayedRobot:
    """Nodes at a robot as `workbench.bench.Live` has them; what it is told goes into a file."""

    def __init__(self, told: Path):
        self._told, self._state = told, "moving"

    def snapshot(self):
        campaign = {
            "state": self._state,
            "reason": REASON,
            "poses": 26,
            "error_unseen": 3.7e-5,
            "curve": {
                "kind": "position",
                "noise": 3.0e-5,
                "points": [
                    {"poses": 0, "error": 9.34e-4, "effects": []},
                    {"poses": 16, "error": 1.18e-4, "effects": []},
                    {"poses": 24, "error": 3.7e-5, "effects": ["backlash"]},
                ],
            },
            "answer": "ended as asked",
        }
        model = {"ok": True, "hash": "0" * 64, "effects": ["backlash"], "since": 0.0, "reason": ""}
        return {
            "streams": [],
            "model": model,
            "samples": {"samples": 26},
            "dropped": [],
            "errors": [],
            "campaign": campaign,
            "trouble": [],
        }

    def steer(self, word):
        with self._told.open("a") as file:
            file.write(word + "\n")
        self._state = {"pause": "paused", "resume": "moving", "stop": "stopped"}[word]

    def close(self):
        pass


if __name__ == "__main__":
    serve(Path(sys.argv[1]), live=PlayedRobot(Path(sys.argv[2])), port=int(sys.argv[3]), show=False)
