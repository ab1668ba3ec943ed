"""The targets of an export, one per file; the file's name is the target's name.

A target is a Python module that defines one or more of these groups of names:

1. `files(model, option=default, ...) -> {name: text}` returns the files to write.
2. For a firmware with parameters of its own:

   - `HOLDS`: the names of the mechanisms that the firmware can represent
   - `project(model)`: the values of the firmware's parameters that fit the model best
   - `settings(paths)`: the settings in the firmware's configuration files. If it reads further
     files that these name, it is `settings(paths, texts=None)`; `texts` replace those of files
   - `firmware(settings)`: the kinematics that the firmware computes with these settings
   - `adapt(settings, numbers)`, optional: the numbers in the units and by the names of these files

3. `edit(model, files) -> ({path: text}, remarks)`: the texts of the user's files with new numbers.
"""
