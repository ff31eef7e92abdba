"""Rendering methods of a rigid tool.

A method decides how the coupling's wrench reaches the tool: MuJoCo's integrator, the actuators'
gains, a weld instead of them, or no coupling at all. Tick arithmetic, ledger, records and audit are
common to all methods.
"""

from hapticbridge.kernel.tuning import Gains as Gains
from hapticbridge.rendering.method import Method as Method
from hapticbridge.rendering.method import refuse_unknowing as refuse_unknowing
from hapticbridge.rendering.methods import COMPENSATED as COMPENSATED
from hapticbridge.rendering.methods import IMPLICIT as IMPLICIT
from hapticbridge.rendering.methods import LOSSLESS_COUPLING as LOSSLESS_COUPLING
from hapticbridge.rendering.methods import METHODS as METHODS
from hapticbridge.rendering.methods import default_method as default_method
from hapticbridge.rendering.methods import method_named as method_named
from hapticbridge.rendering.methods import method_names as method_names
from hapticbridge.rendering.preparation import MEASURED_AGAIN as MEASURED_AGAIN
from hapticbridge.rendering.preparation import check_prepared as check_prepared
from hapticbridge.rendering.preparation import check_scene as check_scene
from hapticbridge.rendering.preparation import contact_stiffness_of as contact_stiffness_of
from hapticbridge.rendering.preparation import prepare as prepare
