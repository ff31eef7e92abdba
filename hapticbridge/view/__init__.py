"""A web page beside a run, or of a recorded one: the scene, the coupling, curves."""

from hapticbridge.view.address import Address as Address
from hapticbridge.view.window import Window as Window
