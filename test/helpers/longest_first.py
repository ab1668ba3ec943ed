"""The order in which workers of pytest-xdist take files of tests: the longest first.

A worker takes file after file. A long file at the end would keep one worker busy alone.
"""

from collections import Counter

# s of processor time: of a test by its mark, and of files that take longer, or much less. Tests of
# pages count by their number: a browser waits for the machine, and has it once the tests with nodes
# have ended.
WIDE_S, QUICK_S = 0.8, 0.1
LONG_FILES_S = {
    "test_docs.py": 80,
    "test_crane.py": 45,
    "test_diagnosis.py": 62,
    "test_camera.py": 60,
    "test_discovery.py": 55,
    "test_campaign.py": 54,
    "test_session.py": 52,
    "test_export_c.py": 40,
    "test_robot_or_device.py": 40,
    "test_examples.py": 38,
    "test_export_bed_fit.py": 37,
    "test_export_heights.py": 37,
    "test_collector.py": 36,
    "test_site.py": 35,
    "test_implausible_readings.py": 33,
    "test_diagnosis_and_add.py": 32,
    "test_fleet.py": 32,
    "test_unexplained_motion.py": 32,
    "test_short_cut.py": 29,
    "test_fit_with_effects.py": 27,
    "test_methods_coverage.py": 27,
    "test_discovery_stations.py": 26,
    "test_study_power.py": 25,
    "test_chain.py": 24,
    "test_stations.py": 24,
    "test_unusual_sizes.py": 23,
    "test_cli.py": 21,
    "test_closed_chain_files.py": 21,
    "test_effects.py": 20,
    "test_few_values.py": 20,
    "test_methods_end_to_end.py": 20,
    "test_fleet_findings.py": 17,
    "test_solvers_agree.py": 15,
    "test_two_at_once.py": 15,
    "test_mechanisms_against_virtual.py": 14,
    "test_drift.py": 12,
    "test_everything_at_once.py": 12,
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
        seconds[path] = LONG_FILES_S.get(path.name, seconds[path])
    items.sort(key=lambda item: (-seconds[item.path], item.path))
