"""Real-time requests to the operating system, and lateness of the loop.

``grants`` makes the requests and undoes them, ``remedies`` names the commands that grant a refused
one, ``pace`` checks that a scene's step fits into the period, ``lateness`` and ``host`` measure.
"""

from hapticbridge.realtime.grants import Grant as Grant
from hapticbridge.realtime.grants import current_priority as current_priority
from hapticbridge.realtime.grants import loop_core as loop_core
from hapticbridge.realtime.grants import memory_at_rest as memory_at_rest
from hapticbridge.realtime.grants import real_time as real_time
from hapticbridge.realtime.grants import wants_real_time as wants_real_time
from hapticbridge.realtime.grants import warn_of_refusals as warn_of_refusals
from hapticbridge.realtime.host import stolen_time as stolen_time
from hapticbridge.realtime.lateness import Lateness as Lateness
from hapticbridge.realtime.lateness import lateness_of as lateness_of
from hapticbridge.realtime.pace import check_pace as check_pace
