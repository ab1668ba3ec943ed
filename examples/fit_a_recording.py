"""How wrong is my robot, and how much better is it after a fit?

The recording holds a Delta that visits 94 poses before a measuring device. A quarter of the poses
is held out: only they show how good the robot is at poses that were not used for the fit.
"""

import parallel_cal as pc

model = pc.read_model("config/delta_mockup_nominal.yaml")
data = pc.load_dataset("bags/delta_backlash", joints=model.joints)

fitted = pc.fit(model, data, hold_out=0.25)
print(fitted)
print("\n".join(pc.show(fitted).splitlines()[-4:]))
pc.write_model(fitted.model, "fitted.yaml")

# Prints:
# FitResult(delta54, 94 samples, 42 of 42 free parameters identified, chi2/dof 1.17)
# before:   606 +- 11 um, 24.99 +- 0.22 arcmin (rms at held-out poses)
# after:    37.6 +- 2.2 um, 0.457 +- 0.022 arcmin
# noise:    30.0 +- 1.2 um, 0.433 +- 0.015 arcmin
# missing:  an error of 22.7 um (rms) beside the noise
