"""Custom scenes: a folder with a user's objects, motions and splits, and the data set `own:FOLDER` that reads it.

The package `handover_marl.assets.building.custom_scenes` builds such folders.
"""
