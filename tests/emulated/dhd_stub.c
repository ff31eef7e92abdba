/* A stand-in for Force Dimension's library with a device behind it, written from the SDK's header.

   Each axis is m x'' = F - b x' - friction + the hand, stepped by 31.25 us in time that only
   stub_advance, or a call that takes time, moves. Functions named stub_ are for the test. */

#include <math.h>
#include <stddef.h>

#define STEP 31.25e-6
#define STUB __attribute__((visibility("default")))

static struct {
  double now, call, mass, damping, friction, resolution, inertia, turn_damping, limit, torque_limit;
  double max_force, max_torque, effector, hand_stiffness, hand_damping, hand_mass;
  double x[3], v[3], turn[3], spin[3], target[3], command[6];
  double commanded, guard_until, spoiled;
  double gap, gap_speed, grip_command, squeeze, gap_spoiled;
  long steps;
  int type, count, is_open, enabled, gravity, expert, watchdog, has_watchdog, fails, buttons;
  int stale, forces, closed, gripper, uncalibrated;
} s;

static const char *text = "no error";

STUB void stub_reset(int type) {
  s = (__typeof__(s)){0};
  s.type = type; s.count = 1; s.mass = 0.25; s.damping = 1.5; s.inertia = 2e-4;
  s.turn_damping = 4e-3; s.limit = 12.0; s.torque_limit = 0.4; s.max_force = -1.0;
  s.max_torque = -1.0; s.effector = 0.19; s.has_watchdog = 1; text = "no error";
  s.gap = 0.025; s.gripper = 1;
}
STUB void stub_mechanics(double mass, double damping, double friction, double resolution) {
  s.mass = mass; s.damping = damping; s.friction = friction; s.resolution = resolution;
}
STUB void stub_hand(double stiffness, double damping, double mass) {
  s.hand_stiffness = stiffness; s.hand_damping = damping; s.hand_mass = mass;
}
STUB void stub_target(double x, double y, double z) {
  s.target[0] = x; s.target[1] = y; s.target[2] = z;
}
STUB void stub_limits(double told, double told_torque) {
  s.max_force = told; s.max_torque = told_torque;
}
STUB void stub_call(double seconds) { s.call = seconds; }
STUB void stub_uncalibrate(int is_waiting) { s.uncalibrated = is_waiting; }
STUB void stub_count(int count) { s.count = count; }
STUB void stub_fail(int is_failing) { s.fails = is_failing; }
STUB void stub_stale(int getters) { s.stale = getters; }
STUB void stub_spoil(double value) { s.spoiled = value; }
STUB void stub_buttons(int mask) { s.buttons = mask; }
STUB void stub_watchdog(int has) { s.has_watchdog = has; }
STUB double stub_force(int axis) { return s.enabled ? s.command[axis] : 0.0; }
STUB double stub_command(int axis) { return s.command[axis]; }
/* the gripper: 0.05 kg and 2 N s/m at the gap; fingers squeeze towards a gap with 2000 N/m */
STUB void stub_squeeze(double gap) { s.squeeze = gap; }
STUB void stub_gripper(int has) { s.gripper = has; }
STUB void stub_spoil_gap(double value) { s.gap_spoiled = value; }
STUB double stub_gap(void) { return s.gap; }
STUB double stub_grip_force(void) { return s.enabled ? s.grip_command : 0.0; }
STUB int stub_gravity(void) { return s.gravity; }
STUB int stub_watchdog_steps(void) { return s.watchdog; }
STUB int stub_enabled(void) { return s.enabled; }
STUB int stub_closed(void) { return s.closed; }

static double rubbed(double v, double rub) {
  return fabs(v) <= rub ? 0.0 : v - copysign(rub, v);
}

static void step(void) {
  for (int i = 0; i < 6 && s.watchdog > 0; i++)
    if (s.now - s.commanded > 125e-6 * s.watchdog) s.command[i] = s.grip_command = 0.0;
  {
    double m = 0.05, b = 2.0 + 8.0 * (s.squeeze > 0.0), k = s.squeeze > 0.0 ? 2000.0 : 0.0;
    double f = stub_grip_force() + k * (s.squeeze - s.gap);
    s.gap_speed = ((m - 0.5 * STEP * b) * s.gap_speed + STEP * f) / (m + 0.5 * STEP * b);
    s.gap = fmin(fmax(s.gap + STEP * s.gap_speed, 0.0), 0.025);
  }
  for (int i = 0; i < 3; i++) {
    double m = s.mass + s.hand_mass, b = s.damping + s.hand_damping;
    double f = stub_force(i) + s.hand_stiffness * (s.target[i] - s.x[i]);
    double before = s.v[i];
    /* trapezoidal in the damping, so that the step's own error is of second order */
    double free = ((m - 0.5 * STEP * b) * before + STEP * f) / (m + 0.5 * STEP * b);
    s.v[i] = rubbed(free, STEP * s.friction / m);
    s.x[i] += 0.5 * STEP * (before + s.v[i]);
    double t = stub_force(3 + i), w = s.spin[i];
    s.spin[i] = ((s.inertia - 0.5 * STEP * s.turn_damping) * w + STEP * t) /
                (s.inertia + 0.5 * STEP * s.turn_damping);
    s.turn[i] += 0.5 * STEP * (w + s.spin[i]);
  }
}

STUB void stub_advance(double now) {
  long due = (long)floor(now / STEP + 1e-6);
  for (; s.steps < due; s.steps++) { s.now = (s.steps + 1) * STEP; step(); }
  if (now > s.now) s.now = now;
}

static int called(char id) {
  stub_advance(s.now + s.call);
  if (s.fails || !s.is_open || id != 0) { text = "communication error"; return -1; }
  return 0;
}

STUB int dhdGetDeviceCount(void) { return s.count; }
STUB int dhdOpenID(char id) {
  if (id < 0 || id >= s.count) { text = "no device found"; return -1; }
  s.is_open = 1;
  return 0; /* one device at a time: its number is always 0 */
}
STUB int dhdClose(char id) { (void)id; s.is_open = 0; s.closed++; return 0; }
STUB int dhdGetSystemType(char id) { return called(id) < 0 ? -1 : s.type; }
STUB int dhdGetStatus(int *status, char id) {
  for (int i = 0; i < 17; i++) status[i] = i < 3; /* powered, connected, started */
  status[3 + !s.uncalibrated] = 1;                /* RESET or IDLE */
  return called(id);
}
STUB int dhdGetSerialNumber(unsigned short *number, char id) { *number = 4711; return called(id); }
STUB double dhdGetMaxForce(char id) { (void)id; return s.max_force; }
STUB double dhdGetMaxTorque(char id) { (void)id; return s.max_torque; }
STUB int dhdGetEffectorMass(double *mass, char id) { *mass = s.effector; return called(id); }
STUB int dhdSetGravityCompensation(int on, char id) { s.gravity = on; return called(id); }
STUB int dhdEnableExpertMode(void) { s.expert = 1; return 0; }
STUB int dhdDisableExpertMode(void) { s.expert = 0; return 0; }
STUB int dhdSetWatchdog(unsigned char steps, char id) {
  if (!s.expert) { text = "expert mode disabled"; return -1; }
  if (!s.has_watchdog) { text = "feature not available"; return -1; }
  s.watchdog = steps;
  return called(id);
}
STUB int dhdEnableForce(unsigned char on, char id) { s.enabled = on; return called(id); }
STUB int dhdGetPosition(double *x, double *y, double *z, char id) {
  double *to[3] = {x, y, z};
  if (called(id) < 0) return -1;
  if (s.stale > 0) { s.stale--; return 1; }
  for (int i = 0; i < 3; i++)
    *to[i] = s.resolution > 0.0 ? s.resolution * rint(s.x[i] / s.resolution) : s.x[i];
  if (s.spoiled != 0.0) *x = s.spoiled;
  return 0;
}
STUB int dhdGetPositionAndOrientationFrame(double *x, double *y, double *z, double m[3][3],
                                           char id) {
  /* Rz(c) Ry(b) Rx(a): for the small turns of the tests each angle is its axis' rotation */
  double ca = cos(s.turn[0]), sa = sin(s.turn[0]), cb = cos(s.turn[1]), sb = sin(s.turn[1]);
  double cc = cos(s.turn[2]), sc = sin(s.turn[2]);
  int code = dhdGetPosition(x, y, z, id);
  if (code != 0) return code;
  m[0][0] = cc * cb; m[0][1] = cc * sb * sa - sc * ca; m[0][2] = cc * sb * ca + sc * sa;
  m[1][0] = sc * cb; m[1][1] = sc * sb * sa + cc * ca; m[1][2] = sc * sb * ca - cc * sa;
  m[2][0] = -sb;     m[2][1] = cb * sa;                m[2][2] = cb * ca;
  if (s.spoiled != 0.0) { m[0][0] = s.spoiled; *x = 0.0; }
  return 0;
}
STUB unsigned dhdGetButtonMask(char id) { (void)id; return (unsigned)s.buttons; }
STUB int dhdSetForceAndTorque(double x, double y, double z, double a, double b, double c,
                              char id) {
  double f = sqrt(x * x + y * y + z * z), t = sqrt(a * a + b * b + c * c);
  double scale = f > s.limit ? s.limit / f : 1.0, turned = t > s.torque_limit ? s.torque_limit / t : 1.0;
  if (called(id) < 0) return -1;
  double command[6] = {scale * x, scale * y, scale * z, turned * a, turned * b, turned * c};
  for (int i = 0; i < 6; i++) s.command[i] = command[i];
  s.grip_command = 0.0;
  s.commanded = s.now;
  return scale < 1.0 || turned < 1.0 ? 2 : 0;
}
STUB int dhdSetForce(double x, double y, double z, char id) {
  return dhdSetForceAndTorque(x, y, z, 0.0, 0.0, 0.0, id);
}
STUB int dhdHasActiveGripper(char id) { return called(id) < 0 ? -1 : s.gripper; }
STUB int dhdGetGripperGap(double *gap, char id) {
  *gap = s.gap_spoiled != 0.0 ? s.gap_spoiled : s.gap;
  return called(id);
}
STUB int dhdSetForceAndTorqueAndGripperForce(double x, double y, double z, double a, double b,
                                             double c, double grip, char id) {
  int code = dhdSetForceAndTorque(x, y, z, a, b, c, id);
  if (code >= 0) s.grip_command = grip;
  return code;
}
STUB int dhdSetForceAndGripperForce(double x, double y, double z, double grip, char id) {
  return dhdSetForceAndTorqueAndGripperForce(x, y, z, 0.0, 0.0, 0.0, grip, id);
}
STUB double dhdGetTime(void) { return s.now; }
STUB const char *dhdErrorGetLastStr(void) { return text; }
