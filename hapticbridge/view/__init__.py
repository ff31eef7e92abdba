"""A web page beside a run, or of a recorded one: the scene, the coupling, curves.

Read ``window`` first: the bridge's interface to the view. It starts ``process``, which reads
positions and records from shared memory and draws them on the ``page``, with shapes from
``geometry``. The ``controls`` send commands back; ``server`` checks each request. ``replay`` is the
page of a recording.
"""

from hapticbridge.view.window import Address as Address
from hapticbridge.view.window import Window as Window
