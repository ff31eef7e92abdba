"""A recorded run as a picture or a film, drawn without a display."""

from hapticbridge.film.studio import ENDINGS as ENDINGS
from hapticbridge.film.studio import Shot as Shot
from hapticbridge.film.studio import draw as draw
from hapticbridge.film.studio import still as still
