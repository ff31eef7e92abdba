/* A stand-in for OpenHaptics' library (HD) with a device behind it, written from the maker's header
   and API reference.

   Each axis is m x'' = F - b x' - friction + the hand, stepped by 31.25 us in time that only
   stub_advance moves, or a thread of its own (stub_thread). Servo ticks come every millisecond.
   Lengths in mm and y up outside, in m inside. Functions named stub_ are for the test. */

#include <math.h>
#include <pthread.h>
#include <stddef.h>
#include <string.h>
#include <time.h>

#define STEP 31.25e-6
#define SERVO 32 /* steps */
#define QUEUE 16
#define STUB __attribute__((visibility("default")))

typedef struct { unsigned code; int internal; unsigned device; } Error;
typedef unsigned (*Callback)(void *);

static struct {
  double now, mass, damping, friction, resolution, max_force, lasting_force;
  double hand_stiffness, hand_damping, hand_mass;
  double x[3], v[3], target[3], force[3], asked[3], shown[3], matrix[9], spoiled;
  long steps, ticks;
  unsigned enabled, calibration, errors[QUEUE];
  int count, is_open, in_frame, is_running, is_frozen, buttons, styles, updates, depth, frames, closed;
  int is_threaded, must_end, was_set;
  Callback callback;
  void *user;
  pthread_t thread;
} s;

static void fail(unsigned code) { if (s.depth < QUEUE) s.errors[s.depth++] = code; }

STUB void stub_reset(void) {
  memset(&s, 0, sizeof s);
  s.mass = 0.1; s.damping = 1.5; s.max_force = 3.3; s.lasting_force = 0.88; s.count = 1;
  s.calibration = 0x5000; s.styles = 4; s.matrix[0] = s.matrix[4] = s.matrix[8] = 1.0;
}
STUB void stub_mechanics(double mass, double damping, double friction, double resolution) {
  s.mass = mass; s.damping = damping; s.friction = friction; s.resolution = resolution;
}
STUB void stub_hand(double stiffness, double damping, double mass) {
  s.hand_stiffness = stiffness; s.hand_damping = damping; s.hand_mass = mass;
}
STUB void stub_target(double x, double y, double z) { /* in the driver's axes, z up */
  s.target[0] = x; s.target[1] = z; s.target[2] = -y;
}
STUB void stub_place(double x, double y, double z) { s.x[0] = x; s.x[1] = y; s.x[2] = z; }
STUB void stub_matrix(int i, double value) { s.matrix[i] = value; } /* row by row, y up */
STUB void stub_limits(double force, double lasting) {
  s.max_force = force; s.lasting_force = lasting;
}
STUB void stub_count(int count) { s.count = count; }
STUB void stub_error(int code) { fail((unsigned)code); }
STUB void stub_freeze(int is_frozen) { s.is_frozen = is_frozen; }
STUB void stub_buttons(int mask) { s.buttons = mask; }
STUB void stub_spoil(double value) { s.spoiled = value; }
STUB void stub_calibration(int state, int styles) {
  s.calibration = (unsigned)state; s.styles = styles;
}
STUB void stub_thread(int is_threaded) { s.is_threaded = is_threaded; }
STUB double stub_force(int axis) { return s.enabled & 1 ? s.force[axis] : 0.0; }
STUB double stub_now(void) { return s.now; }
STUB int stub_enabled(void) { return (int)s.enabled; }
STUB int stub_updates(void) { return s.updates; }
STUB int stub_closed(void) { return s.closed; }
STUB int stub_frames(void) { return s.frames; }

static double rubbed(double v, double rub) {
  return fabs(v) <= rub ? 0.0 : v - copysign(rub, v);
}

static void step(void) {
  for (int i = 0; i < 3; i++) {
    double m = s.mass + s.hand_mass, b = s.damping + s.hand_damping;
    double f = stub_force(i) + s.hand_stiffness * (s.target[i] - s.x[i]);
    double before = s.v[i];
    /* trapezoidal in the damping, so that the step's own error is of second order */
    double free = ((m - 0.5 * STEP * b) * before + STEP * f) / (m + 0.5 * STEP * b);
    s.v[i] = rubbed(free, STEP * s.friction / m);
    s.x[i] += 0.5 * STEP * (before + s.v[i]);
  }
}

STUB void stub_advance(double now) {
  long due = (long)floor(now / STEP + 1e-6);
  for (; s.steps < due; s.steps++) {
    s.now = (s.steps + 1) * STEP;
    step();
    if ((s.steps + 1) % SERVO == 0 && s.is_running && !s.is_frozen && s.callback != NULL) {
      s.ticks++;
      if (s.callback(s.user) != 1) s.callback = NULL;
    }
  }
  if (now > s.now) s.now = now;
}

static double seconds(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return t.tv_sec + 1e-9 * t.tv_nsec;
}

static void *servo_thread(void *unused) {
  double begin = seconds() - s.now;
  (void)unused;
  while (!s.must_end) {
    struct timespec pause = {0, 500000};
    nanosleep(&pause, NULL);
    stub_advance(seconds() - begin);
  }
  return NULL;
}

STUB unsigned hdInitDevice(const char *name) {
  if (s.count == 0 || (name != NULL && strcmp(name, "Right Device") != 0)) {
    fail(0x0303);
    return 0xFFFFFFFFu;
  }
  if (s.is_open) { fail(0x0301); return 0xFFFFFFFFu; }
  s.is_open = 1;
  return 7u;
}
STUB void hdDisableDevice(unsigned id) {
  if (id != 7u || s.is_running) fail(0x0104);
  s.is_open = 0; s.enabled = 0; s.closed++;
}
STUB void hdMakeCurrentDevice(unsigned id) { if (id != 7u) fail(0x0104); }
STUB void hdBeginFrame(unsigned id) {
  if (id != 7u || s.in_frame) fail(0x0400);
  s.in_frame = 1; s.was_set = 0;
  for (int i = 0; i < 3; i++)
    s.shown[i] = s.resolution > 0.0 ? s.resolution * rint(s.x[i] / s.resolution) : s.x[i];
}
STUB void hdEndFrame(unsigned id) {
  if (id != 7u || !s.in_frame) fail(0x0401);
  s.in_frame = 0; s.frames++;
  if (!s.was_set) return; /* the last force holds */
  double size = sqrt(s.asked[0] * s.asked[0] + s.asked[1] * s.asked[1] + s.asked[2] * s.asked[2]);
  if (size > s.max_force * (1.0 + 1e-9) && s.max_force > 0.0) { fail(0x0201); return; }
  for (int i = 0; i < 3; i++) s.force[i] = s.asked[i];
}
static unsigned bit(unsigned capability) { return 1u << (capability & 0xF); }
STUB void hdEnable(unsigned what) {
  if (what < 0x4000 || what > 0x4004) fail(0x0100); else s.enabled |= bit(what);
}
STUB void hdDisable(unsigned what) { s.enabled &= ~bit(what); }
STUB void hdGetDoublev(unsigned what, double *to) {
  const double limit = 0.2;
  if (what < 0x2200 && !s.in_frame) { fail(0x0102); return; }
  switch (what) {
  case 0x2050:
    for (int i = 0; i < 3; i++) to[i] = 1e3 * s.shown[i];
    if (s.spoiled != 0.0) to[0] = s.spoiled;
    return;
  case 0x2052:
    for (int column = 0; column < 3; column++)
      for (int row = 0; row < 4; row++)
        to[4 * column + row] = row < 3 ? s.matrix[3 * row + column] : 0.0;
    for (int i = 0; i < 3; i++) to[12 + i] = 1e3 * s.shown[i];
    to[15] = 1.0;
    return;
  case 0x2550:
    for (int i = 0; i < 3; i++) { to[i] = -1e3 * limit; to[i + 3] = 1e3 * limit; }
    return;
  case 0x2603: if (s.max_force > 0.0) to[0] = s.max_force; else fail(0x0100); return;
  case 0x2604: if (s.lasting_force > 0.0) to[0] = s.lasting_force; else fail(0x0100); return;
  default: fail(0x0100);
  }
}
STUB void hdGetIntegerv(unsigned what, int *to) {
  if (what == 0x2000 && s.in_frame) *to = s.buttons;
  else if (what == 0x2555) *to = s.styles;
  else fail(0x0100);
}
STUB void hdSetDoublev(unsigned what, const double *from) {
  if (what != 0x2700 || !s.in_frame) { fail(0x0102); return; }
  memcpy(s.asked, from, sizeof s.asked);
  s.was_set = 1;
}
STUB const char *hdGetString(unsigned what) {
  if (what == 0x2501) return "Touch";
  if (what == 0x2504) return "S4711";
  fail(0x0100);
  return NULL;
}
STUB Error hdGetError(void) {
  Error found = {0, 0, 7u};
  if (s.depth > 0) { found.code = s.errors[--s.depth]; found.internal = -3; }
  return found;
}
STUB const char *hdGetErrorString(unsigned code) {
  return code == 0x0500 ? "Invalid priority" : NULL;
}
STUB unsigned hdCheckCalibration(void) { return s.calibration; }
STUB void hdUpdateCalibration(unsigned style) {
  s.updates++;
  if (style == 0 || (style & (unsigned)s.styles) == 0) { fail(0x0101); return; }
  if (s.calibration == 0x5001) s.calibration = 0x5000;
}
STUB void hdStartScheduler(void) {
  s.is_running = 1; s.must_end = 0;
  if (s.is_threaded) pthread_create(&s.thread, NULL, servo_thread, NULL);
}
STUB void hdStopScheduler(void) {
  s.must_end = 1;
  if (s.is_threaded && s.is_running) pthread_join(s.thread, NULL);
  s.is_running = 0;
}
STUB unsigned long hdScheduleAsynchronous(Callback callback, void *user, unsigned short priority) {
  if (priority != 0xFFFF) fail(0x0500);
  s.callback = callback; s.user = user;
  return 3ul;
}
STUB void hdUnschedule(unsigned long task) { if (task == 3ul) s.callback = NULL; }
