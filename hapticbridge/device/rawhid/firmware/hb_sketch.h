// What sketches have in common: a motor behind a PWM, the timer of the periods, and the pace of the
// state frames. The sketch defines read_position() and write_force().
//
//   HbSketch device(sheet, 100);                 // period of the loop in us
//   void control_tick() { device.tick(); }
//   device.start(control_tick);                  // in setup()
//   device.poll();                               // in loop()
//   device.receive(frame);                       // or receive_byte(byte)
//   if (device.answer(frame)) send(frame);
//   if (device.state(buttons, status, frame)) send(frame);
//   if (device.more(frame)) send(frame);
//
// With rotation about up to three axes, as of a six-axis arm, define HB_SKETCH_POSE before this file:
// the sketch then defines read_pose() and write_wrench() in their place.
//
// An AVR has no floating-point unit and is too slow for a loop of its own: it follows force frames
// alone, loop() runs its periods, and its watchdog restarts a processor that hangs. On a Teensy an
// IntervalTimer runs them. For another board define HB_OWN_TIMER and hb_start_timer().
//
// Licence: Apache-2.0, as the rest of hapticbridge.
#ifndef HB_SKETCH_H
#define HB_SKETCH_H

#include "hb_board.h"

#ifdef HB_SKETCH_POSE

// Reads the handle's position in m and its rotation, a quaternion (w, x, y, z). What the device lacks
// stays as it is at the call: 0 m, and no turn. Called from the interrupt.
void read_pose(float position[3], float rotation[4]);

// Applies a force in N and a torque in N m at the handle, zero where there is to be none: by the
// transposed Jacobian, the motors' torques. Called from the interrupt: it must not wait, print or
// allocate.
void write_wrench(const float force[3], const float torque[3]);

#else

// Reads the handle's position in m; axes that the device lacks stay 0. Of a device that only turns, a
// knob, it is the angle in rad about its axis, and the force below a torque in N m. Called from the
// interrupt.
void read_position(float position[3]);

// Applies a force in N at the handle, zero where there is to be none. Called from the interrupt: it
// must not wait, print or allocate.
void write_force(const float force[3]);

#endif

// Returns a sheet of which all is unknown, for a device without rotation and grip.
inline HbSheet hb_unknown_sheet() {
  HbSheet sheet;
  memset(&sheet, 0, sizeof sheet);
  sheet.mass = sheet.damping = sheet.friction = sheet.resolution = sheet.delay = NAN;
  sheet.rotational_inertia = sheet.rotational_damping = sheet.torque_limit = NAN;
  sheet.loop_delay = NAN;
  return sheet;
}

// Brushed motor behind a PWM without a current sensor: its force is that of the motor at rest.
struct HbMotor {
  float torque_constant;  // N m/A, the motor's data sheet
  float resistance;       // ohm, winding, driver and wires together
  float inductance;       // H, winding
  float supply;           // V, at the driver
  float duty_limit;       // of full PWM, 0 to 1; raise it when it has proved safe
  float travel;           // m of handle per rad of the motor
  volatile bool is_saturated;

  // Returns the largest force in N at the handle.
  float force_limit() const {
    return duty_limit * supply / resistance * torque_constant / travel;
  }

  // Returns the share of full PWM for a force in N, within the limit; its sign is the force's.
  float duty(float force) {
    const float share = force / force_limit();
    is_saturated = !(fabsf(share) <= 1.0f);
    if (!is_saturated) return duty_limit * share;
    return share > 0.0f ? duty_limit : share < 0.0f ? -duty_limit : 0.0f;  // none for no number
  }

  // Returns the time in s in which the current follows the voltage. It counts as a delay.
  float lag() const { return inductance / resistance; }

  // Status bits of a state frame.
  uint8_t status() const { return is_saturated ? HB_SATURATED : 0; }
};

#ifdef __AVR__

#include <avr/wdt.h>

#ifdef HB_SKETCH_POSE
#error "HB_SKETCH_POSE is for boards with a floating-point unit"
#endif

static const bool HB_HAS_LOOP = false;

class HbSketchBoard {
 public:
  HbSketchBoard(const HbSheet& sheet, uint32_t period_us)
      : board_(sheet), period_us_(period_us), last_us_(0) {}

  void start(void (*)()) { wdt_enable(WDTO_15MS); }

  void poll() {
    wdt_reset();
    if (micros() - last_us_ < period_us_) return;
    last_us_ = micros();
    const HbWrench wrench = board_.wrench(last_us_);
    write_force(board_.turns() ? wrench.torque : wrench.force);
  }

  void tick() {}

  bool more(uint8_t[HB_FRAME_BYTES]) { return false; }

 protected:
  void latch(float position[3], float[4]) { read_position(position); }

  HbDevice board_;

 private:
  const uint32_t period_us_;
  uint32_t last_us_;
};

#else

#ifdef HB_SKETCH_POSE
typedef HbPoseBoard HbOwnBoard;
#else
typedef HbBoard HbOwnBoard;
#endif

#ifdef TEENSYDUINO
inline void hb_start_timer(void (*tick)(), uint32_t period_us) {
  static IntervalTimer timer;
  timer.begin(tick, period_us);
}
#elif defined(HB_OWN_TIMER)
void hb_start_timer(void (*tick)(), uint32_t period_us);
#else
#error "define HB_OWN_TIMER and hb_start_timer(): see 'hapticbridge guide stiff-device'"
#endif

static const bool HB_HAS_LOOP = true;

class HbSketchBoard {
 public:
  HbSketchBoard(const HbSheet& sheet, uint32_t period_us)
      : board_(sheet, 1e-6f * (float)period_us), period_us_(period_us) {}

  // Starts the periods.
  void start(void (*tick)()) { hb_start_timer(tick, period_us_); }

  // Runs what is due in loop().
  void poll() {}

  // Sets the temperature of the motors and its limit in degrees Celsius, see HbBoard.
  void set_temperature(float temperature, float limit) {
    board_.set_temperature(temperature, limit);
  }

  // Runs one period, in the timer's interrupt. It renders without loop(): if that hangs, no frame
  // is received, and the patience or the watchdog of the last one ends the force here. A processor
  // that has stopped keeps its PWM: drive an enable input of the driver by a hardware watchdog.
  void tick() {
    float position[3] = {0.0f, 0.0f, 0.0f}, force[3];
#ifdef HB_SKETCH_POSE
    float rotation[4] = {1.0f, 0.0f, 0.0f, 0.0f}, torque[3];
    read_pose(position, rotation);
    board_.tick(position, rotation, micros(), force, torque);
    write_wrench(force, torque);
#else
    read_position(position);
    board_.tick(position, micros(), force);
    write_force(force);
#endif
  }

  // Fills in the second frame of the last state; returns false if there is none.
  bool more(uint8_t frame[HB_FRAME_BYTES]) { return board_.more(frame); }

 protected:
  // Reads the newest position in m, and the quaternion with rotation.
  void latch(float position[3], float rotation[4]) { board_.latched(position, rotation); }

  HbOwnBoard board_;

 private:
  const uint32_t period_us_;
};

#endif

// A device with the pace of its state frames and the speed in them.
class HbSketch : public HbSketchBoard {
 public:
  // Creates a device without a force; states are sent at the sheet's rate.
  HbSketch(const HbSheet& sheet, uint32_t period_us)
      : HbSketchBoard(sheet, period_us),
        state_period_us_((uint32_t)(1e6f / sheet.rate + 0.5f)),
        due_us_(0),
        last_us_(0) {
    memset(last_, 0, sizeof last_);
    memset(last_turn_, 0, sizeof last_turn_);
    last_turn_[0] = 1.0f;
  }

  // Takes one report from the host.
  void receive(const uint8_t frame[HB_FRAME_BYTES]) { board_.receive(frame, micros()); }

  // Takes one byte from the host on a serial line.
  void receive_byte(uint8_t byte) { board_.receive_byte(byte, micros()); }

  // Fills in the requested page of the sheet; returns false without a request.
  bool answer(uint8_t frame[HB_FRAME_BYTES]) { return board_.answer(frame); }

  // Fills in a state frame, once per period; returns false before.
  bool state(uint16_t buttons, uint8_t status, uint8_t frame[HB_FRAME_BYTES]) {
    const uint32_t now_us = micros();
    if (now_us - due_us_ < state_period_us_) return false;
    due_us_ += state_period_us_;
    if (now_us - due_us_ >= state_period_us_) due_us_ = now_us;  // late: not a burst to catch up
    HbMotion motion;
    memset(&motion, 0, sizeof motion);
    float* position = board_.turns() ? motion.rotation : motion.position;
    float* velocity = board_.turns() ? motion.angular_velocity : motion.velocity;
    const float since = 1e-6f * (float)(now_us - last_us_);
    float rotation[4] = {1.0f, 0.0f, 0.0f, 0.0f};
    latch(position, rotation);
    for (int i = 0; i < 3; i++) {
      velocity[i] = (position[i] - last_[i]) / since;
      last_[i] = position[i];
    }
#ifdef HB_SKETCH_POSE
    const float none[4] = {1.0f, 0.0f, 0.0f, 0.0f};
    hb_turn(none, rotation, motion.rotation);
    hb_turn(last_turn_, rotation, motion.angular_velocity);
    for (int i = 0; i < 3; i++) motion.angular_velocity[i] /= since;
    memcpy(last_turn_, rotation, sizeof rotation);
#endif
    last_us_ = now_us;
    motion.buttons = buttons;
    motion.status = status;
    board_.state(motion, now_us, frame);
    return true;
  }

 private:
  const uint32_t state_period_us_;
  uint32_t due_us_, last_us_;
  float last_[3], last_turn_[4];
};

#endif
