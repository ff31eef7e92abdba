// The firmware of a three-axis board for a cross compiler, or with HB_SKETCH_POSE of a six-axis one, on
// hardware that is one register: what it needs of flash and memory. It is linked, not run.
#define HB_OWN_TIMER
#include <stdint.h>

static volatile uint32_t hardware;

static inline void noInterrupts() { __asm__ volatile("cpsid i" ::: "memory"); }
static inline void interrupts() { __asm__ volatile("cpsie i" ::: "memory"); }
static inline uint32_t micros() { return hardware; }

#include "hb_sketch.h"

static HbMotor motor = {0.0136f, 2.5f, 0.2e-3f, 12.0f, 0.2f, 0.005f, false};

static void read_lines(float position[3]) {
  for (int i = 0; i < 3; i++) position[i] = 1e-5f * (float)(int32_t)hardware;
}

static void write_motors(const float force[3]) {
  for (int i = 0; i < 3; i++) hardware = (uint32_t)(int32_t)(1023.0f * motor.duty(force[i]));
}

#ifdef HB_SKETCH_POSE
void read_pose(float position[3], float rotation[4]) {
  float turn[3];
  read_lines(position);
  read_lines(turn);
  hb_turned(turn, rotation, rotation);
}

void write_wrench(const float force[3], const float torque[3]) {
  write_motors(force);
  write_motors(torque);
}
#else
void read_position(float position[3]) { read_lines(position); }

void write_force(const float force[3]) { write_motors(force); }
#endif

void hb_start_timer(void (*tick)(), uint32_t period_us) {
  hardware = period_us;
  tick();
}

static HbSheet sheet() {
  HbSheet sheet = hb_unknown_sheet();
  sheet.name = "three axes";
  sheet.axes = HB_X | HB_Y | HB_Z;
  sheet.rate = 990.0f;
  sheet.force_limit = motor.force_limit();
  sheet.speed_limit = 2.0f;
  return sheet;
}

static HbSketch& device() {
  static HbSketch own(sheet(), 100);
  return own;
}

static void control_tick() { device().tick(); }

extern "C" {
void start() {
  uint8_t frame[HB_FRAME_BYTES] = {0};
  HbSketch& own = device();
  own.start(control_tick);
  for (;;) {
    own.poll();
    own.receive(frame);
    own.receive_byte((uint8_t)hardware);
    if (own.answer(frame) || own.state(0, motor.status(), frame) || own.more(frame)) {
      hardware = frame[0];
    }
  }
}

}
