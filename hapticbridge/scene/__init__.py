"""MJCF scenes put behind a haptic device: loading, the handle and its coupling, checks.

Read ``load`` first: it reads a scene, puts the handle and its coupling into it (``attach``,
``start``), compiles it (``compiler``) and refuses what no hand should feel (``checks``). What comes
out is ``scene.Scene``, which a bridge steps. ``source`` keeps the files' bytes for the recording;
``parameter_file`` and ``parameters`` are what a user may set, ``custom`` what the file says of
itself, ``library`` the scenes that are shipped. ``contact_rule``, with ``contact_check`` and
``contact_concerns``, is what was measured of contacts that create energy. ``methods`` and ``weld``
serve the methods that exist to be compared.
"""

from hapticbridge.scene.custom import custom_numbers as custom_numbers
from hapticbridge.scene.custom import custom_text as custom_text
from hapticbridge.scene.library import scene_names as scene_names
from hapticbridge.scene.library import scene_path as scene_path
from hapticbridge.scene.load import SceneSource as SceneSource
from hapticbridge.scene.load import compile_scene as compile_scene
from hapticbridge.scene.load import load_scene as load_scene
from hapticbridge.scene.load import plain_model as plain_model
from hapticbridge.scene.load import read_scene as read_scene
from hapticbridge.scene.parameter_file import Parameter as Parameter
from hapticbridge.scene.parameter_file import scene_parameters as scene_parameters
from hapticbridge.scene.parameters import settings_from as settings_from
from hapticbridge.scene.scene import Scene as Scene
from hapticbridge.scene.source import SourceFile as SourceFile
