"""A run: from the options of a user to the loop.

Read ``bridge`` first, which is the loop. ``options`` are what a user chooses; ``request`` is the
choice of all hands as a recording keeps it, and resolves to a setup for each hand. ``session``
takes hold of scene, device and recording and releases them. ``hands`` describes several hands,
``commands`` what changes during a run, ``slow_scene`` a scene that is stepped beside the loop,
``fidelity`` compares a scene's own motion with its file's.
``description`` writes and reads the metadata of a recording; ``summary`` says how the run went.
"""
