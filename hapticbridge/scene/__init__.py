"""MJCF scenes behind a haptic device: loading, handle, coupling and checks.

Read ``load`` first. It reads a scene, finds what the hand holds (``grip``), adds the handle and its
coupling (``handle``), compiles it (``compile``) and refuses unsuitable scenes (``checks``). The
result is a ``scene.Scene``, which a bridge steps. ``source`` keeps the files' bytes for the
recording, ``parameters`` the scene's settable numbers, ``contacts`` a measured rule for contacts
that create energy. ``first_faults`` are those that a run tells at its start, each a ``fault`` with
its place in the files (``source_map``).
"""

from hapticbridge.scene.compile import custom_numbers as custom_numbers
from hapticbridge.scene.compile import custom_text as custom_text
from hapticbridge.scene.grip import grips as grips
from hapticbridge.scene.load import SceneSource as SceneSource
from hapticbridge.scene.load import compile_scene as compile_scene
from hapticbridge.scene.load import load_scene as load_scene
from hapticbridge.scene.load import own_grips as own_grips
from hapticbridge.scene.load import plain_model as plain_model
from hapticbridge.scene.load import read_scene as read_scene
from hapticbridge.scene.load import scene_names as scene_names
from hapticbridge.scene.load import scene_path as scene_path
from hapticbridge.scene.parameters import Parameter as Parameter
from hapticbridge.scene.parameters import scene_parameters as scene_parameters
from hapticbridge.scene.parameters import settings_from as settings_from
from hapticbridge.scene.scene import Scene as Scene
from hapticbridge.scene.source import SourceFile as SourceFile
