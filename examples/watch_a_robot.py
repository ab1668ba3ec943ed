"""Has a calibrated robot changed since, and which part? Four belts, without a measuring device."""

import numpy as np

import parallel_cal as pc
from parallel_cal.watch.watch import DAY, Watch

START, SIGMA = 1.8e9, 0.3e-3  # s since 1970; noise of a reading, m
DRAWN = np.array([[-1.5, 1.0], [1.5, 1.0], [1.5, -1.0], [-1.5, -1.0]])

random = np.random.default_rng(1)
anchors = DRAWN + random.normal(0, 5e-3, DRAWN.shape)
anchors[3], anchors[2, 1] = DRAWN[3], DRAWN[2, 1]  # they define the frame


def record(day, samples, slip=0.0):
    """Lengths of the belts at places that nobody measures; belt 2 has slipped."""
    places = random.uniform(-1, 1, (samples, 2)) * [1.0, 0.7]
    lengths = np.linalg.norm(places[:, None] - anchors, axis=2)
    lengths += random.normal(0, SIGMA, lengths.shape)
    lengths[:, 1] += slip
    time = START + DAY * day + 10.0 * np.arange(samples)
    return pc.Dataset.from_arrays(
        ("line1", "line2", "line3", "line4"), lengths, np.zeros((samples, 3)),
        measured=np.zeros(6, bool), joint_sigma=SIGMA, conditions={"time": time},
    )  # fmt: skip


drawn = pc.new_model(pc.mechanisms.load("cable", anchors=DRAWN.tolist(), zero="anchors"))
model = pc.fit(drawn, record(-1, 150), fix=["line4.A_?", "line3.A_y"]).model
pc.write_model(model, "belts.yaml")

watch = Watch(model)
for day in range(10):
    samples = record(day, 20, slip=1.5e-3 if day >= 7 else 0.0)
    samples.to_json(f"day{day}.json")  # for the command line
    watch = watch.add(samples, START + DAY * day, name=f"day {day}")
    print(f"day {day}: R = {min(watch.trend[-1].statistic / DAY, 10_000):.3g} days")

best = watch.suspects[0]
print(f"alarm: {watch.alarm.recording}, {best.part} with {100 * watch.parts[best.part]:.0f} %")
print(f"{best.parameter}: {1e3 * best.value:.2f} +- {1e3 * best.sigma:.2f} mm")

# Prints:
# day 0: R = 0 days
# day 1: R = 0.44 days
# day 2: R = 0.909 days
# day 3: R = 1.44 days
# day 4: R = 1.8 days
# day 5: R = 2.11 days
# day 6: R = 2.52 days
# day 7: R = 1e+04 days
# day 8: R = 1e+04 days
# day 9: R = 1e+04 days
# alarm: day 7, line2 with 100 %
# line2.offset: -1.57 +- 0.09 mm
