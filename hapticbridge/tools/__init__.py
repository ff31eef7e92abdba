"""Recordings as other programs take them.

``export`` writes tables, ``dataset`` a data set for learning. ``compare`` finds where two
recordings differ.
"""
