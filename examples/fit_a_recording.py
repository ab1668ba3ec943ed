"""How wrong is my robot, and how much better is it after a fit?

The recording holds a Delta that visits 94 poses before a measuring device. A quarter of the poses
is held out: only they show how good the robot is at poses that were not used for the fit.
"""

import parallel_cal as pc

model = pc.read_model("config/delta_mockup_nominal.yaml")
data = pc.load_dataset("bags/delta_backlash", joints=model.joints)

fitted = pc.fit(model, data, hold_out=0.25)
print(fitted)
print("\n".join(pc.show(fitted).splitlines()[:6]))
pc.write_model(fitted.model, "fitted.yaml")

# Prints:
# FitResult(delta54, 94 samples, 42 of 42 free parameters identified, chi2/dof 1.17)
# 94 samples, 42 of 42 free parameters identified, chi2/dof 1.17
#                          before  after  held-out, before  held-out, after  noise floor  unit
# position error, mean     598.78  30.20            598.78            33.99        27.45  um
# position error, rms      606.02  33.66            606.02            37.59        29.98  um
# orientation error, mean   24.93   0.39             24.93             0.42         0.40  arcmin
# orientation error, rms    24.99   0.42             24.99             0.46         0.43  arcmin
