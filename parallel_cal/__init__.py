"""Kinematic calibration of parallel robots.

Examples
--------
>>> import parallel_cal as pc
>>> model = pc.read_model("config/delta_mockup_nominal.yaml")
>>> data = pc.load_dataset("bags/delta_backlash", joints=model.joints)
>>> result = pc.fit(model, data)
>>> diagnosis = pc.diagnose(result.model, data)
>>> diagnosis.effects
('backlash',)

Notes
-----
A name is imported when it is first used; `__init__.pyi` lists all names. `pc.effects`,
`pc.mechanisms` and `pc.sensors` are the plug-in folders: `pc.effects.names()` lists one,
`pc.effects.load("backlash")` gives one plug-in.
"""

import lazy_loader

__version__ = "1.0.0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
