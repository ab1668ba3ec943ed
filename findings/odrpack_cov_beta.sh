#!/bin/sh
# Versions: odrpack 0.7.0
# Question: 50 points of a line with noise of 0.1 are fitted without weights. Is the sigma of a parameter the
#   root of the diagonal of `cov_beta`?
# Guess: "Yes: `sd_beta` is the root of the diagonal of `cov_beta`, as its name says."
# True: `cov_beta` is not scaled by the residuals, `sd_beta` is. The root of the diagonal is 11.6 times
#   `sd_beta` here. With weights of 1 / 0.1^2 both are about right, but `sd_beta` still follows the residuals.
# Matters: A covariance of identified parameters, and the uncertainty of every pose that is computed from it,
#   is wrong by the variance of the noise in the units of the data: in metres far too large, in micrometres
#   too small. Multiply `cov_beta` by `res_var`, or weigh with the known noise.
cd "$(dirname "$0")" && ./with_packages odrpack==0.7.0 numpy==2.4.6 <<'END'
import numpy as np
from odrpack import odr_fit

x = np.linspace(0, 1, 50)
y = 2 + 3 * x + 0.1 * np.random.default_rng(0).normal(size=50)
A = np.column_stack([np.ones(50), x])
true = 0.1 * np.sqrt(np.diag(np.linalg.inv(A.T @ A)))
print("true sigmas", true.round(4))
for weight in (1.0, 100.0):
    found = odr_fit(
        lambda x, b: b[0] + b[1] * x, x, y, np.ones(2), weight_y=np.full(50, weight), task="OLS"
    )
    root = np.sqrt(np.diag(found.cov_beta))
    print(f"weight {weight:g}: sd_beta {found.sd_beta.round(4)}, root of cov_beta {root.round(4)}")
    assert np.allclose(root * np.sqrt(found.res_var), found.sd_beta, rtol=1e-4)
    assert np.allclose(root, true * (10 if weight == 1 else 1), rtol=1e-3)
    assert np.allclose(found.sd_beta, true, rtol=0.2)
END
# Seen:
#   true sigmas [0.0279 0.048 ]
#   weight 1: sd_beta [0.024  0.0414], root of cov_beta [0.2787 0.4802]
#   weight 100: sd_beta [0.024  0.0414], root of cov_beta [0.0279 0.048 ]
