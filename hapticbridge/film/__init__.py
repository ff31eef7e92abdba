"""A recorded run as a picture or a film, drawn without a display.

Read ``studio`` first: it finds a renderer and starts ``artist``, the process that draws a ``stage``
with it; ``encoder`` makes a film of the frames.
"""

from hapticbridge.film.studio import ENDINGS as ENDINGS
from hapticbridge.film.studio import Shot as Shot
from hapticbridge.film.studio import draw as draw
from hapticbridge.film.studio import still as still
