"""Real-time requests to the operating system, and lateness of the loop.

``realtime`` makes the requests, names the command that grants a refused one and checks that a step
of the scene fits into the period; ``doctor`` measures this machine against a baseline.
"""

from hapticbridge.realtime.realtime import Grant as Grant
from hapticbridge.realtime.realtime import Lateness as Lateness
from hapticbridge.realtime.realtime import busy_step_time as busy_step_time
from hapticbridge.realtime.realtime import check_pace as check_pace
from hapticbridge.realtime.realtime import current_priority as current_priority
from hapticbridge.realtime.realtime import lateness_of as lateness_of
from hapticbridge.realtime.realtime import loop_core as loop_core
from hapticbridge.realtime.realtime import memory_at_rest as memory_at_rest
from hapticbridge.realtime.realtime import real_time as real_time
from hapticbridge.realtime.realtime import scene_ticks_for as scene_ticks_for
from hapticbridge.realtime.realtime import stolen_time as stolen_time
from hapticbridge.realtime.realtime import wants_real_time as wants_real_time
from hapticbridge.realtime.realtime import warn_of_refusals as warn_of_refusals
from hapticbridge.realtime.realtime import warn_of_slow_motion as warn_of_slow_motion
