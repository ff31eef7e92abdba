// Loop of a haptic device on its own board: it pulls at a tool that the host shows, at 4 to 20 kHz.
// Plain C++11, this header alone: no Arduino, no heap, no exceptions.
//
//   HbLoop loop(1e-4f);                      // period T in s, kept by a timer's interrupt
//   loop.show(shown);                        // when the host has shown its tool
//   loop.tick(position, force);              // in the interrupt: position in m -> force in N
//
//   HbPoseLoop loop(1e-4f);                  // with rotation about up to three axes
//   loop.tick(position, rotation, force, torque);
//
// In each period, with the handle at h, the tool shown at y, e = h - y, and all in the device's
// frame, the force on the tool is
//
//   f = P_F(K e + B/T (dh - dy)),    P_F(u) = u min(1, F / |u|)
//
// and the device gets -f. The tool moves toward y*, where the host says that it is by now, only as
// far as a tank pays for it:
//
//   D = E + sum P - W >= 0,    P = f . dy
//
// P in J is what the coupling gives to the tool in the period, W what the host's scene has taken of
// it, and E a credit. The spring's energy V is convex in e, so the hand has put in at least
// sum P + V on a device of b >= K T/2 + B, whatever the host shows, and however late. The time t from
// reading a position to its force counts, too: b >= K (T/2 + 3 t/2) + B is enough up to t = T.
//
// An HbPoseLoop has such a coupling of rotations beside it, with e the rotation vector from the
// tool to the handle and dh, dy those of their motions; planes stop the tool's motion along lines
// alone. A force that comes late counts on a spring that gives |df|^2 / 2K more than its work when
// the tool moves, as it does along lines. About a large twist it gives less, so P is the least of
// f . dy and V's fall - |df|^2 / 2K with what the damper gives. Where a twist passes half a turn the
// torque reverses at once, and no damping bears that: at 2.5 rad the tool turns with the handle.
//
// A loop belongs to one interrupt. What a main loop receives for it is copied with interrupts off.
//
// Licence: Apache-2.0, as the rest of hapticbridge.
#ifndef HB_LOOP_H
#define HB_LOOP_H

#include <math.h>
#include <stdint.h>
#include <string.h>

#include "hb_constants.h"
#include "hb_rotation.h"

// Energy in pJ: sums of it are exact, and need no unit for double precision.
typedef int64_t HbEnergy;

// Returns an energy in J in pJ, rounded down; up to 140 J. A conversion to 32 bits is one instruction.
inline HbEnergy hb_picojoules(float joules) {
  const float exact = 1e12f * joules;
  const bool is_large = !(exact < 2e9f && exact > -2e9f);
  float scaled = is_large ? exact * (1.0f / 65536.0f) : exact;
  if (scaled > 2e9f) scaled = 2e9f;
  if (scaled < -2e9f) scaled = -2e9f;
  int32_t whole = (int32_t)scaled;
  if ((float)whole > scaled) whole--;
  return is_large ? (HbEnergy)whole * 65536 : (HbEnergy)whole;
}

// Returns an energy in pJ in J, rounded down, at least 0.
inline float hb_joules(HbEnergy energy) {
  if (energy <= 0) return 0.0f;
  if (energy < 0x7FFFFFFF) return 0.999999e-12f * (float)(int32_t)energy;
  const HbEnergy coarse = energy >> 16;
  return 0.065535e-6f * (float)(int32_t)(coarse < 0x7FFFFFFF ? coarse : 0x7FFFFFFF);
}

// Gains of a coupling in the device's frame; of rotations in N m/rad, N m s/rad and N m.
struct HbGains {
  float stiffness;  // K in N/m
  float damping;    // B in N s/m
  float level;      // F in N
};

// Surface near the tool: it stops the tool between two of its poses.
struct HbPlane {
  float normal[3];  // away from the surface, of length 1
  float gap;        // m, from the surface to the tool as it was shown
};

// Tool as the host shows it.
struct HbShown {
  float position[3];  // m, in the device's frame
  float velocity[3];  // m/s
  HbEnergy work;      // W in pJ, all that the scene has taken so far
  uint8_t planes;     // of plane
  bool has_velocity;  // without one the tool is led to the position within the time between two
  HbPlane plane[HB_PLANES];
  float rotation[4];  // quaternion (w, x, y, z), of an HbPoseLoop alone
  float turning[3];   // rad/s
};

// How the host wants the loop to be.
struct HbSetting {
  HbGains gains;
  HbGains turn_gains;  // of rotations, of an HbPoseLoop alone
  HbEnergy credit;  // E in pJ, given once, when the force first begins
  float passing;    // energy in J that may be under way between two shows
  float fade;       // s, in which the force rises, fades, and gains change
  float patience;   // s without a show after which the force fades
  bool is_enabled;  // false: the force fades
};

// What the loop tells of itself.
struct HbReport {
  HbEnergy passed;     // sum of P in pJ
  HbEnergy tank;       // D in pJ
  int64_t changes;     // sum of |w_k - w_(k-1)| over periods and axes in uN
  uint32_t held_back;  // periods in which the tank was too low for y*
  float position[3];   // h in m
  float tool[3];       // y in m
  float force[3];      // on the device in N
  float share;         // of the gains in force, 0 to 1
  bool is_faulty;      // a position was no place: no force until the board restarts
  // of an HbPoseLoop
  float rotation[4];   // of the handle
  float tool_turn[4];  // rotation of the shown tool
  float torque[3];     // on the device in N m
};

// Sum of the squares of the twist and the tool's turn in rad up to which a spring of rotation is like
// one along lines: what half a radian lacks is 1 % of what a late force counts on.
static const float HB_FLAT = 0.25f;

// How well the timer keeps the period.
struct HbPace {
  uint32_t ticks;           // periods so far
  uint32_t missed;          // of them, those that came a period late or more
  float temperature;        // degrees Celsius of the motors; NAN if unknown
  float temperature_limit;  // at which they are switched off; NAN if unknown
};

template <bool TURNS>
class HbLoopOf {
 public:
  // Creates a loop without a force; `period` is T in s.
  explicit HbLoopOf(float period)
      : period_(period), rate_(1.0f / period), share_(0.0f), has_started_(false), has_credit_(false) {
    memset(&setting_, 0, sizeof setting_);
    memset(&shown_, 0, sizeof shown_);
    memset(&report_, 0, sizeof report_);
    memset(velocity_, 0, sizeof velocity_);
    memset(turning_, 0, sizeof turning_);
    gains_ = earlier_ = setting_.gains;
    turn_gains_ = earlier_turn_ = setting_.turn_gains;
    report_.rotation[0] = report_.tool_turn[0] = 1.0f;
    moved_ = 1.0f;
    scene_work_ = cap_ = 0;
    age_ = silence_ = 0;
    horizon_ = lead_ = 0.0f;
    is_placed_ = false;
    has_shown_ = false;
  }

  // Sets gains and times; the gains move there within `fade`.
  void set(const HbSetting& setting) {
    if (memcmp(&setting.gains, &setting_.gains, sizeof setting.gains) != 0 ||
        memcmp(&setting.turn_gains, &setting_.turn_gains, sizeof setting.turn_gains) != 0) {
      earlier_ = gains_;
      earlier_turn_ = turn_gains_;
      moved_ = 0.0f;
    }
    setting_ = setting;
    // the tank holds twice what the springs have at their levels, F^2/2K, and what is under way
    const HbGains& gains = setting.gains;
    const HbGains& turn = setting.turn_gains;
    float held = gains.stiffness > 0.0f ? gains.level * gains.level / gains.stiffness : 0.0f;
    if (TURNS && turn.stiffness > 0.0f) {
      held += 2.0f * energy(turn, fminf(turn.level / turn.stiffness, HB_HALF_TURN));
    }
    cap_ = hb_picojoules(held + setting.passing);
  }

  // Ends the force at once, until a setting enables it again. Nothing of the tank is left for what
  // is shown then, but a loan stays.
  void end() {
    setting_.is_enabled = false;
    share_ = 0.0f;
    memset(&gains_, 0, sizeof gains_);
    earlier_ = turn_gains_ = earlier_turn_ = gains_;
    if (report_.tank > 0) report_.tank = 0;
    has_shown_ = false;
  }

  // Shows the tool. `placed`: it was put there, and the force begins anew, without what was left in
  // the tank for another one.
  void show(const HbShown& shown, bool placed) {
    const float since = fminf((float)(silence_ < 1 ? 1 : silence_) * period_, HB_SLOWEST);
    HbEnergy taken = shown.work - scene_work_;
    const bool is_new = placed || !has_shown_;  // or the frame that placed it was lost
    if (is_new) {  // it may be another scene, which gives back nothing that this one took
      taken = positive(shown.work) - positive(scene_work_);
      if (taken < 0) taken = 0;
      if (report_.tank > 0) report_.tank = 0;
    }
    report_.tank -= taken;
    scene_work_ = shown.work;
    shown_ = shown;
    age_ = silence_ = 0;
    is_placed_ = is_placed_ || is_new;
    has_shown_ = true;
    if (TURNS) memcpy(from_turn_, shown.rotation, sizeof from_turn_);
    if (shown.has_velocity) {
      copy(from_, shown.position);
      copy(velocity_, shown.velocity);
      copy(turning_, shown.turning);
      horizon_ = HB_LONGEST * since;
      lead_ = 0.0f;
      return;
    }
    copy(from_, report_.tool);
    for (int i = 0; i < 3; i++) velocity_[i] = (shown.position[i] - from_[i]) / since;
    if (TURNS) {
      memcpy(from_turn_, report_.tool_turn, sizeof from_turn_);
      hb_turn(from_turn_, shown.rotation, turning_);
      for (int i = 0; i < 3; i++) turning_[i] /= since;
    }
    horizon_ = since;
    lead_ = period_;
  }

  // Runs one period: `position` of the handle in m to `force` on the device in N.
  void tick(const float position[3], float force[3]) { tick(position, 0, force, 0); }

  // Runs one period of an HbPoseLoop: position in m and quaternion to force in N and torque in N m.
  void tick(const float position[3], const float rotation[4], float force[3], float torque[3]) {
    Goal goal;
    Motion motion;
    if (!is_place(position) || (TURNS && !hb_is_rotation(rotation))) report_.is_faulty = true;
    if (report_.is_faulty) {
      memset(force, 0, 3 * sizeof(float));
      memset(report_.force, 0, sizeof report_.force);
      if (TURNS) {
        memset(torque, 0, 3 * sizeof(float));
        memset(report_.torque, 0, sizeof report_.torque);
      }
      return;
    }
    take(position, rotation);
    change_gains();
    aim(goal);
    float share = 1.0f;
    const float least = -hb_joules(report_.tank);
    float released = given(1.0f, goal, motion);
    if (released < least) {
      report_.held_back++;
      share = paid(goal, released, least);
      released = given(share, goal, motion);
      if (released < least) {  // by rounding
        share = 0.0f;
        released = given(share, goal, motion);
      }
    }
    float change = 0.0f;
    for (int i = 0; i < 3; i++) {
      report_.tool[i] += motion.moved[i];
      change += fabsf(-motion.u[i] - report_.force[i]);
      force[i] = report_.force[i] = -motion.u[i];
      if (TURNS) torque[i] = report_.torque[i] = -motion.torque[i];
    }
    if (TURNS) memcpy(report_.tool_turn, motion.rotation, sizeof report_.tool_turn);
    report_.changes += (int32_t)(1e6f * change);
    const HbEnergy passed = hb_picojoules(released);
    report_.passed += passed;
    report_.tank += passed;
    if (age_ > 0 && report_.tank > cap_) report_.tank = cap_;
    if (age_ < INT32_MAX) age_++;
    if (silence_ < INT32_MAX) silence_++;
  }

  const HbReport& report() const { return report_; }

 private:
  // Way of the tool to y*, the rotation there, and the rotation's V in J and its torque before.
  struct Goal {
    float step[3], turn[3], rotation[4], held, elastic[3];
  };

  // Motion of the tool as it is rounded, and what the coupling gives to it: f in N, torque in N m.
  struct Motion {
    float moved[3], u[3], turned[3], torque[3], rotation[4];
  };

  static HbEnergy positive(HbEnergy energy) { return energy > 0 ? energy : 0; }

  static void copy(float to[3], const float from[3]) { memcpy(to, from, 3 * sizeof(float)); }

  static void subtract(const float a[3], const float b[3], float result[3]) {
    for (int i = 0; i < 3; i++) result[i] = a[i] - b[i];
  }

  static float dot(const float a[3], const float b[3]) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  }

  // True for a place within 16 km, so that no product of it overflows. It tests the bits, so that it
  // holds under -ffast-math too.
  static bool is_place(const float vector[3]) {
    uint32_t bits[3];
    memcpy(bits, vector, sizeof bits);
    for (int i = 0; i < 3; i++) {
      if ((bits[i] & 0x7F800000u) >= 0x46800000u) return false;
    }
    return true;
  }

  // Energy of the spring in J at a length in m.
  static float energy(const HbGains& gains, float length) {
    const float full = gains.stiffness * length;
    if (full <= gains.level) return 0.5f * full * length;
    const float elastic = gains.level / gains.stiffness;
    return gains.level * (length - 0.5f * elastic);
  }

  // Length in m at which the spring holds an energy in J.
  static float length_of(const HbGains& gains, float energy) {
    if (gains.stiffness <= 0.0f || gains.level <= 0.0f) return 0.0f;
    const float elastic = 0.5f * gains.level * gains.level / gains.stiffness;
    if (energy <= elastic) return sqrtf(2.0f * energy / gains.stiffness);
    return gains.level / gains.stiffness + (energy - elastic) / gains.level;
  }

  // Takes the handle's pose, and its motion since the last one.
  void take(const float position[3], const float rotation[4]) {
    float turn[4];
    if (TURNS) {
      memcpy(turn, rotation, sizeof turn);
      hb_normalize(turn);
    }
    if (!has_started_) {
      copy(report_.position, position);
      copy(report_.tool, position);
      if (TURNS) {
        memcpy(report_.rotation, turn, sizeof turn);
        memcpy(report_.tool_turn, turn, sizeof turn);
      }
      has_started_ = true;
    }
    subtract(position, report_.position, handle_step_);
    copy(report_.position, position);
    if (TURNS) {
      hb_turn(report_.rotation, turn, handle_turn_);
      memcpy(report_.rotation, turn, sizeof turn);
    }
  }

  // Moves the gains on; where their spring would gain energy, the shown tool slips to the handle.
  void change_gains() {
    const bool is_on = setting_.is_enabled && has_shown_ && !is_placed_ &&
                       (float)silence_ * period_ <= setting_.patience;
    const float pace = setting_.fade > period_ ? period_ / setting_.fade : 1.0f;
    if (is_on && !has_credit_) {
      report_.tank += setting_.credit;
      has_credit_ = true;
    }
    share_ = is_on ? fminf(share_ + pace, 1.0f) : fmaxf(share_ - pace, 0.0f);
    if (is_placed_ && share_ == 0.0f) is_placed_ = false;
    const HbGains before = gains_, turn_before = turn_gains_;
    // all in proportion: between two couplings that the device bears lie only such
    moved_ = fminf(moved_ + pace, 1.0f);
    blend(earlier_, setting_.gains, gains_);
    if (TURNS) blend(earlier_turn_, setting_.turn_gains, turn_gains_);
    report_.share = share_;
    if (is_raised(before, gains_)) {
      float stretch[3];
      subtract(report_.position, report_.tool, stretch);
      const float kept = kept_share(before, gains_, stretch);
      if (kept < 1.0f) {
        for (int i = 0; i < 3; i++) report_.tool[i] = report_.position[i] - kept * stretch[i];
      }
    }
    if (TURNS && is_raised(turn_before, turn_gains_)) {
      float twist[3];
      hb_turn(report_.tool_turn, report_.rotation, twist);
      const float slip = 1.0f - kept_share(turn_before, turn_gains_, twist);
      for (int i = 0; i < 3; i++) twist[i] *= slip;
      if (slip > 0.0f) hb_turned(twist, report_.tool_turn, report_.tool_turn);
    }
  }

  static bool is_raised(const HbGains& before, const HbGains& now) {
    return now.stiffness > before.stiffness || now.level > before.level;
  }

  // Returns the share of a stretch at which a spring holds no more than under its gains before.
  static float kept_share(const HbGains& before, const HbGains& now, const float stretch[3]) {
    const float length = sqrtf(dot(stretch, stretch));
    const float held = energy(before, length);
    if (length <= 0.0f || energy(now, length) <= held) return 1.0f;
    return length_of(now, held) / length;
  }

  void blend(const HbGains& earlier, const HbGains& goal, HbGains& now) const {
    now.stiffness = between(earlier.stiffness, goal.stiffness);
    now.damping = between(earlier.damping, goal.damping);
    now.level = between(earlier.level, goal.level);
  }

  float between(float earlier, float goal) const {
    return (1.0f - moved_) * earlier + moved_ * share_ * goal;
  }

  // Finds y*: where the tool is by now, moved out of the planes. A goal at no place is where it is.
  void aim(Goal& goal) const {
    float place[3];
    if (TURNS) memcpy(goal.rotation, report_.tool_turn, sizeof goal.rotation);
    if (!has_shown_) {
      copy(place, report_.tool);
    } else {
      const float time = fminf((float)age_ * period_ + lead_, horizon_);
      for (int i = 0; i < 3; i++) place[i] = from_[i] + time * velocity_[i];
      leave_planes(place);
      if (!is_place(place)) copy(place, report_.tool);
      if (TURNS) {
        float turn[3];
        for (int i = 0; i < 3; i++) turn[i] = time * turning_[i];
        if (is_place(turn)) hb_turned(turn, from_turn_, goal.rotation);
      }
    }
    subtract(place, report_.tool, goal.step);
    if (TURNS) {
      float twist[3];
      hb_turn(report_.tool_turn, report_.rotation, twist);
      goal.held = energy(turn_gains_, sqrtf(dot(twist, twist)));
      for (int i = 0; i < 3; i++) goal.elastic[i] = turn_gains_.stiffness * twist[i];
      limit(goal.elastic, turn_gains_.level);
      hb_turn(report_.tool_turn, goal.rotation, goal.turn);
    }
  }

  void leave_planes(float place[3]) const {
    for (int round = 0; round < 4; round++) {
      bool has_moved = false;
      for (int k = 0; k < shown_.planes; k++) {
        const HbPlane& plane = shown_.plane[k];
        float moved[3];
        subtract(place, shown_.position, moved);
        const float inside = -plane.gap - dot(plane.normal, moved);
        if (inside <= 0.0f) continue;
        for (int i = 0; i < 3; i++) place[i] += inside * plane.normal[i];
        has_moved = true;
      }
      if (!has_moved) return;
    }
  }

  // Returns P in J if the tool moves by a share of the way to its goal.
  float given(float share, const Goal& goal, Motion& motion) const {
    const float damped = gains_.damping * rate_;
    for (int i = 0; i < 3; i++) {
      const float tool = report_.tool[i] + share * goal.step[i];
      motion.moved[i] = tool - report_.tool[i];
      motion.u[i] = gains_.stiffness * (report_.position[i] - tool) +
                    damped * (handle_step_[i] - motion.moved[i]);
    }
    limit(motion.u, gains_.level);
    const float work = dot(motion.u, motion.moved);
    return TURNS ? work + given_by_turn(share, goal, motion) : work;
  }

  // Returns the part of P that rotation has.
  float given_by_turn(float share, const Goal& goal, Motion& motion) const {
    if (share == 1.0f) {
      memcpy(motion.rotation, goal.rotation, sizeof motion.rotation);
    } else if (share == 0.0f) {
      memcpy(motion.rotation, report_.tool_turn, sizeof motion.rotation);
    } else {
      float turn[3];
      for (int i = 0; i < 3; i++) turn[i] = share * goal.turn[i];
      hb_turned(turn, report_.tool_turn, motion.rotation);
    }
    float twist[3], elastic[3];
    hb_turn(motion.rotation, report_.rotation, twist);
    float angle = sqrtf(dot(twist, twist));
    if (angle > HB_LARGEST_TWIST) {
      const float kept = HB_LARGEST_TWIST / angle;
      float slip[3];
      for (int i = 0; i < 3; i++) {
        slip[i] = (1.0f - kept) * twist[i];
        twist[i] *= kept;
      }
      hb_turned(slip, motion.rotation, motion.rotation);
      angle = HB_LARGEST_TWIST;
    }
    hb_turn(report_.tool_turn, motion.rotation, motion.turned);
    const float damped = turn_gains_.damping * rate_;
    for (int i = 0; i < 3; i++) {
      elastic[i] = turn_gains_.stiffness * twist[i];
      motion.torque[i] = elastic[i] + damped * (handle_turn_[i] - motion.turned[i]);
    }
    limit(motion.torque, turn_gains_.level);
    const float work = dot(motion.torque, motion.turned);
    if (turn_gains_.stiffness <= 0.0f) return work;
    if (angle * angle + dot(motion.turned, motion.turned) < HB_FLAT) return work;
    float damper[3], change[3];
    limit(elastic, turn_gains_.level);
    subtract(motion.torque, elastic, damper);
    subtract(goal.elastic, elastic, change);
    const float lacking = 0.5f * dot(change, change) / turn_gains_.stiffness;
    const float fallen = goal.held - energy(turn_gains_, angle) - lacking;
    return fminf(work, fallen + dot(damper, motion.turned));
  }

  // Makes a force or torque one of at most a level.
  static void limit(float u[3], float level) {
    const float size = sqrtf(dot(u, u));
    if (size > level) {
      const float ratio = level / size;
      for (int i = 0; i < 3; i++) u[i] *= ratio;
    }
  }

  // Returns a share of the way for which the tank pays. Below the level P is a parabola of the
  // share, a r - c r^2; elsewhere smaller shares are tried.
  float paid(const Goal& goal, float last_given, float least) const {
    Motion motion;
    float share = 0.0f, high = 1.0f, last = 1.0f, trial = 0.5f;
    for (int k = 0; k < HB_TRIALS; k++) {
      const float released = given(trial, goal, motion);
      if (released < least) {
        high = trial;
      } else {
        share = trial;
      }
      const float curve = (released / trial - last_given / last) / (last - trial);
      const float slope = released / trial + curve * trial;
      last = trial;
      last_given = released;
      trial = share == 0.0f ? high / 16.0f : 0.5f * (share + high);
      if (curve > 0.0f) {
        const float inner = fmaxf(slope * slope - 4.0f * curve * least, 0.0f);
        const float root = HB_NEAR * (slope + sqrtf(inner)) / (2.0f * curve);
        if (share > 0.0f && fabsf(root - share) <= (1.0f - HB_NEAR) * share) break;
        if (share < root && root < high) trial = root;
      }
      if (trial == last) break;
    }
    return share;
  }

  const float period_, rate_;
  HbSetting setting_;
  HbGains gains_, earlier_;  // in force, and when they were set anew
  HbGains turn_gains_, earlier_turn_;
  HbShown shown_;
  HbReport report_;
  HbEnergy scene_work_, cap_;
  float from_[3], velocity_[3], handle_step_[3];
  float from_turn_[4], turning_[3], handle_turn_[3];
  float horizon_, lead_, share_, moved_;
  int32_t age_, silence_;
  bool has_started_, has_credit_, has_shown_, is_placed_;
};

typedef HbLoopOf<false> HbLoop;
typedef HbLoopOf<true> HbPoseLoop;

#endif
