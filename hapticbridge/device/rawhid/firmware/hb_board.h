// A device whose board runs the loop, and follows force frames where a host sends them instead.
//
//   HbBoard board(sheet, 1e-4f);             // the sheet gets its loop_rate from T
//   void interrupt() {                       // every T, by a timer
//     float x[3] = {0, 0, 0}, f[3];
//     read_position(x);                      // m
//     board.tick(x, micros(), f);
//     write_force(f);                        // N
//   }
//   board.receive(frame, micros());          // as of HbDevice, in the main loop
//   if (board.answer(frame)) send(frame);
//   board.state(motion, micros(), frame); send(frame);
//   if (board.more(frame)) send(frame);
//
// An HbPoseBoard renders rotation about up to three axes beside lines. Its tick() takes the handle's
// rotation as a quaternion, too, and gives a torque in N m. Each of its states takes two frames.
//
// Define HB_LOCK and HB_UNLOCK before this file where noInterrupts() and interrupts() are others.
//
// Licence: Apache-2.0, as the rest of hapticbridge.
#ifndef HB_BOARD_H
#define HB_BOARD_H

#include "hb_protocol.h"

#ifndef HB_LOCK
#define HB_LOCK noInterrupts
#define HB_UNLOCK interrupts
#endif

// Periods of state frames between two frames with the loop's counters.
static const uint8_t HB_REPORT_EVERY = 32;

// Time between two periods, in T, up to which a timer is not slow: clocks differ by less.
static const float HB_SLOW = 1.01f;

template <bool TURNS>
class HbBoardOf {
 public:
  // Creates a board without a force; `period` is T in s.
  HbBoardOf(const HbSheet& sheet, float period)
      : device_(with_loop(sheet, period)),
        loop_(period),
        period_us_(1e6f * period),
        late_us_(0.0f),
        last_us_(0),
        is_loop_(false),
        is_unfit_(false),
        has_more_(false),
        frames_(0) {
    memset(&pace_, 0, sizeof pace_);
    set_temperature(NAN, NAN);
  }

  // Decodes one report from the host, as HbDevice does, and gives its order to the loop.
  bool receive(const uint8_t frame[HB_FRAME_BYTES], uint32_t now_us) {
    const bool is_valid = device_.receive(frame, now_us);
    if (is_valid) pass_on();
    return is_valid;
  }

  // Takes one byte of a serial line, as HbDevice does.
  bool receive_byte(uint8_t byte, uint32_t now_us) {
    const bool is_valid = device_.receive_byte(byte, now_us);
    if (is_valid) pass_on();
    return is_valid;
  }

  // Fills in the requested page of the sheet; returns false without a request.
  bool answer(uint8_t frame[HB_FRAME_BYTES]) { return device_.answer(frame); }

  // Fills in the next state frame, or now and then the loop's counters.
  void state(const HbMotion& motion, uint32_t now_us, uint8_t frame[HB_FRAME_BYTES]) {
    HB_LOCK();
    const HbReport report = loop_.report();
    const HbPace pace = pace_;
    is_unfit_ = (motion.status & (HB_FAULT | HB_NOT_READY)) != 0;
    HB_UNLOCK();
    has_more_ = false;
    if (!device_.is_loop()) {
      device_.state(motion, now_us, frame);
      HB_LOCK();
      command_ = device_.command();
      HB_UNLOCK();
    } else if (++frames_ >= HB_REPORT_EVERY) {
      frames_ = 0;
      device_.loop_report(report, pace, frame);
    } else {
      device_.loop_state(motion, report, now_us, frame);
      has_more_ = TURNS;
      if (TURNS) device_.loop_turn(motion, report, more_);
    }
  }

  // Fills in the second frame of the last state; returns false if there is none.
  bool more(uint8_t frame[HB_FRAME_BYTES]) {
    if (has_more_) memcpy(frame, more_, sizeof more_);
    const bool had_more = has_more_;
    has_more_ = false;
    return had_more;
  }

  // Runs one period, in the timer's interrupt: `position` of the handle in m to `force` in N, or
  // angles in rad to torques in N m of a device that only turns about one axis.
  void tick(const float position[3], uint32_t now_us, float force[3]) {
    tick(position, 0, now_us, force, 0);
  }

  // Runs one period of an HbPoseBoard: position in m and quaternion to force in N and torque in N m.
  void tick(const float position[3], const float rotation[4], uint32_t now_us, float force[3],
            float torque[3]) {
    if (pace_.ticks++ > 0) keep_pace((float)(now_us - last_us_));
    last_us_ = now_us;
    if (!is_loop_ || is_unfit_) loop_.end();  // or its spring would be stretched without a force
    loop_.tick(position, rotation, force, torque);
    if (is_loop_) return;
    const HbWrench wrench = command_.wrench(now_us);
    memcpy(force, device_.turns() ? wrench.torque : wrench.force, 3 * sizeof(float));
    if (TURNS) memcpy(torque, wrench.torque, 3 * sizeof(float));
  }

  // True if the device only turns.
  bool turns() const { return device_.turns(); }

  // Copies the position of the last period, and of an HbPoseBoard the quaternion.
  void latched(float position[3], float rotation[4]) const {
    HB_LOCK();
    memcpy(position, loop_.report().position, 3 * sizeof(float));
    if (TURNS) memcpy(rotation, loop_.report().rotation, 4 * sizeof(float));
    HB_UNLOCK();
  }

  // Sets the temperature of the motors in degrees Celsius, and the one at which the sketch sets
  // HB_FAULT_TEMPERATURE, for the host.
  void set_temperature(float temperature, float limit) {
    pace_.temperature = temperature;
    pace_.temperature_limit = limit;
  }

 private:
  static HbSheet with_loop(HbSheet sheet, float period) {
    sheet.loop_rate = 1.0f / period;
    if (TURNS) sheet.axes |= HB_POSE;
    return sheet;
  }

  // Counts missed periods: those of a gap, and those that a slow timer loses in the long run.
  void keep_pace(float since) {
    late_us_ = fmaxf(late_us_ + since - HB_SLOW * period_us_, fminf(late_us_, 0.0f));
    const float missed = floorf(late_us_ / period_us_ + 0.5f);
    pace_.missed += (uint32_t)missed;
    late_us_ -= missed * period_us_;
  }

  void pass_on() {
    const HbOrder& order = device_.order();
    HB_LOCK();
    is_loop_ = device_.is_loop();
    command_ = device_.command();
    if (order.kind != HbOrder::NONE) loop_.set(order.setting);
    if (order.kind == HbOrder::SHOW) loop_.show(order.shown, order.is_placed);
    HB_UNLOCK();
  }

  HbDevice device_;
  HbLoopOf<TURNS> loop_;
  HbCommand command_;
  HbPace pace_;
  const float period_us_;
  float late_us_;  // behind the timer's due time, as far as no missed period counts for it
  uint32_t last_us_;
  bool is_loop_, is_unfit_, has_more_;
  uint8_t frames_;
  uint8_t more_[TURNS ? HB_FRAME_BYTES : 1];
};

typedef HbBoardOf<false> HbBoard;
typedef HbBoardOf<true> HbPoseBoard;

#endif
