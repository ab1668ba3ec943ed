"""The order in which workers of pytest-xdist take files of tests: the longest first.

A worker takes file after file. A long file at the end would keep one worker busy alone.
"""

from collections import Counter

# s of processor time: of a test by its mark, and of files that take longer. Tests of pages count by
# their number: a browser waits for the machine, and has it once the tests with nodes have ended.
WIDE_S, QUICK_S = 0.8, 0.1
LONG_FILES_S = {
    "test_docs.py": 150,
    "test_campaign.py": 125,
    "test_discovery.py": 125,
    "test_camera.py": 95,
    "test_diagnosis.py": 90,
    "test_implausible_readings.py": 75,
    "test_examples.py": 75,
    "test_robot_or_device.py": 70,
    "test_export_c.py": 60,
    "test_session.py": 50,
    "test_export_heights.py": 50,
    "test_diagnosis_and_add.py": 45,
    "test_chain.py": 40,
    "test_site.py": 40,
    "test_virtual_arms.py": 36,
    "test_shelf_truth.py": 35,
    "test_stations.py": 33,
    "test_unusual_sizes.py": 22,
    "test_recordings_diagnosed.py": 21,
    "test_two_at_once.py": 15,
    "test_drift.py": 15,
}


def sort_by_duration(items):
    """Sort tests by the time that their file takes, the longest first.

    The tests of a file stay together and in order. Of a file in the list, quick tests alone count
    by their number.
    """
    seconds, wide = Counter(), set()
    for item in items:
        is_wide = item.get_closest_marker("wide") is not None
        seconds[item.path] += WIDE_S if is_wide else QUICK_S
        if is_wide:
            wide.add(item.path)
    for path in wide:
        seconds[path] = max(seconds[path], LONG_FILES_S.get(path.name, 0))
    items.sort(key=lambda item: (-seconds[item.path], item.path))
