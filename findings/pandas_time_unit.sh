#!/bin/sh
# Versions: pandas 3.1.1
# Question: What does pd.to_datetime(texts).astype("int64") return?
# Guess: "Nanoseconds since 1970, as it always did."
# True: It depends on the digits of the text. "10:00:00.500000" gives microseconds, "10:00:00.500000000"
#   nanoseconds. Timestamp.value is in nanoseconds for both.
# Matters: The log of the robot has six digits, that of the tracker nine. `astype("int64") / 1e9` puts one
#   of them into January 1970, and a join by the nearest time finds no partner, or wrong ones if both are
#   cut to seconds of the run.
cd "$(dirname "$0")" && ./with_packages pandas==3.1.1 numpy==2.4.6 <<'END'
import pandas as pd

found = {}
for text in ("2026-11-28 10:00:00.500000", "2026-11-28 10:00:00.500000000"):
    times = pd.to_datetime([text])
    found[len(text)] = int(times.astype("int64")[0])
    print(f"{text}: {found[len(text)]}, {times.dtype}, value {times[0].value}")
    assert times[0].value == 1795860000500000000
assert found == {26: 1795860000500000, 29: 1795860000500000000}
END
# Seen:
#   2026-11-28 10:00:00.500000: 1795860000500000, datetime64[us], value 1795860000500000000
#   2026-11-28 10:00:00.500000000: 1795860000500000000, datetime64[ns], value 1795860000500000000
