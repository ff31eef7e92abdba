"""A web page beside a run, or of a recorded one: the scene, the coupling, curves.

Read ``window`` first: the view as the bridge sees it, a process (``live``) that is told what
happens. ``show`` follows the run from the ring's records, ``pursuit`` picks it up again where it
was lost, and both give a ``sight``, all that the page needs to know of an instant. ``page`` draws
it: bodies from ``props``, whose surface is ``skin`` and ``wrap``, the coupling from ``ghost``,
curves from ``trace``. ``controls`` and ``sliders`` take what is asked for; ``server`` and
``address`` say who may. ``replay`` is the page of a recording.
"""

from hapticbridge.view.address import Address as Address
from hapticbridge.view.window import Window as Window
