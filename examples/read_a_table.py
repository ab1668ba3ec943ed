"""How do I read the table of somebody else's measurements?

A column map says which column is which quantity, in which unit. The table here is a real one: a
hexapod whose strings run on spools, its readings in motor revolutions, its poses by motion
capture. The noise of neither is known; it is estimated.
"""

import parallel_cal as pc

model = pc.read_model("real/jugglebot/model.yaml")
data = pc.load_dataset(
    "real/jugglebot/poses_108.csv",
    mechanism=model.mechanism,
    columns="real/jugglebot/columns.yaml",
)
print(data)

fitted = pc.fit(model, data)
print(fitted)

# Prints:
# Dataset(108 samples of 6 joints, conditions: direction, travel; real/jugglebot/poses_108.csv)
# FitResult(stewart42, 108 samples, 42 of 42 free parameters identified, chi2/dof 1)
