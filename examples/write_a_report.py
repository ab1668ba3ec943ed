"""How do I show a customer what was found?"""

from pathlib import Path

import parallel_cal as pc

model = pc.read_model("config/delta_mockup_nominal.yaml")
data = pc.load_dataset("bags/delta_backlash", joints=model.joints)
better = pc.add(pc.fit(model, data).model, "backlash", data)

report = pc.report(better.model, data, effects=["hysteresis"])
Path("report.html").write_text(pc.page(report), encoding="utf-8")
print("report.html written:", Path("report.html").stat().st_size > 10_000)

# Prints:
# report.html written: True
