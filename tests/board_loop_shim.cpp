// C entry points to the loop on the board, for ctypes; and a hand that tries to gain energy from it.
#include <deque>
#include <random>
#include <utility>
#include <vector>

static void noInterrupts() {}
static void interrupts() {}
#include "hb_board.h"

namespace {

// numbers: K, B, F, E, energy under way, fade, patience, and K, B, F of rotations
HbSetting setting_of(const float* numbers, int is_enabled) {
  HbSetting setting;
  setting.turn_gains.stiffness = numbers[7];
  setting.turn_gains.damping = numbers[8];
  setting.turn_gains.level = numbers[9];
  setting.gains.stiffness = numbers[0];
  setting.gains.damping = numbers[1];
  setting.gains.level = numbers[2];
  setting.credit = (HbEnergy)(1e12 * numbers[3]);
  setting.passing = numbers[4];
  setting.fade = numbers[5];
  setting.patience = numbers[6];
  setting.is_enabled = is_enabled != 0;
  return setting;
}

// Either loop.
struct Loop {
  HbLoop lines;
  HbPoseLoop poses;
  const bool turns;

  Loop(float period, bool is_turning) : lines(period), poses(period), turns(is_turning) {}
};

// Either board.
struct Board {
  HbBoard lines;
  HbPoseBoard poses;
  const bool turns;

  Board(const HbSheet& sheet, float period, bool is_turning)
      : lines(sheet, period), poses(sheet, period), turns(is_turning) {}
};

struct Message {
  long due;
  int kind;  // 0: shown, 1: setting
  bool placed;
  HbShown shown;
  HbSetting setting;
};

}  // namespace

extern "C" {

void turn_between(const float* from, const float* to, float* turn) { hb_turn(from, to, turn); }

void turn_from(const float* turn, const float* from, float* to) { hb_turned(turn, from, to); }

Loop* loop_new(float period, int turns) { return new Loop(period, turns != 0); }

void loop_set(Loop* loop, const float* numbers, int is_enabled) {
  loop->lines.set(setting_of(numbers, is_enabled));
  loop->poses.set(setting_of(numbers, is_enabled));
}

// numbers: position and velocity, quaternion and angular velocity, surfaces
void loop_show(Loop* loop, const float* numbers, double work, int planes, int has_velocity,
               int placed) {
  HbShown shown;
  memset(&shown, 0, sizeof shown);
  memcpy(shown.position, numbers, 12);
  memcpy(shown.velocity, numbers + 3, 12);
  memcpy(shown.rotation, numbers + 6, 16);
  memcpy(shown.turning, numbers + 10, 12);
  shown.work = (HbEnergy)(1e12 * work);
  shown.planes = (uint8_t)planes;
  shown.has_velocity = has_velocity != 0;
  for (int k = 0; k < planes; k++) {
    memcpy(shown.plane[k].normal, numbers + 13 + 4 * k, 12);
    shown.plane[k].gap = numbers[16 + 4 * k];
  }
  loop->lines.show(shown, placed != 0);
  loop->poses.show(shown, placed != 0);
}

// pose: position and quaternion; wrench: force and torque
void loop_tick(Loop* loop, const float* pose, float* wrench) {
  if (loop->turns) {
    loop->poses.tick(pose, pose + 3, wrench, wrench + 3);
  } else {
    loop->lines.tick(pose, wrench);
  }
}

void loop_report(const Loop* loop, double* works, float* poses) {
  const HbReport& report = loop->turns ? loop->poses.report() : loop->lines.report();
  works[0] = 1e-12 * (double)report.passed;
  works[1] = 1e-12 * (double)report.tank;
  works[2] = 1e-6 * (double)report.changes;
  works[3] = report.held_back;
  works[4] = report.share;
  memcpy(poses, report.position, 12);
  memcpy(poses + 3, report.tool, 12);
  memcpy(poses + 6, report.tool_turn, 16);
}

// Lets a hand push a device against a wall at x = 0 and tap on it, through a link of some delay,
// rendered by the loop on the board or by forces of the host. The device has a mass, damping,
// Coulomb friction, and an encoder with steps. Returns in `found`: the largest travel in m of the
// handle in the last half second, the most energy in J that the motor has given beyond what b burned,
// the depth in m at the end, and the largest force in N.
//
// numbers: T, K, B, F, encoder's step, mass, b, f_c, delay of the link both ways, push in N
void wall(const double* numbers, int is_on_board, double* found) {
  const double period = numbers[0], stiffness = numbers[1], step = numbers[4], mass = numbers[5];
  const double b = numbers[6], friction = numbers[7], delay = numbers[8], push = numbers[9];
  const double substep = 2e-6, host_period = 1e-3, duration = 3.0;
  const float setting[10] = {(float)stiffness, (float)numbers[2], (float)numbers[3], 0.0f, 0.0f,
                             0.01f, 0.05f};
  HbLoop loop((float)period);
  loop.set(setting_of(setting, 1));
  double x = 0.01, v = 0.0, motor = 0.0, given = 0.0, low = 1.0, high = -1.0;
  float force[3] = {0.0f, 0.0f, 0.0f};
  std::deque<std::pair<double, double> > seen, sent;  // times of arrival and numbers
  double next_board = 0.0, next_host = 0.0, newest = x, last = x;
  found[1] = found[3] = 0.0;
  for (double time = 0.0; time < duration; time += substep) {
    const double read = step > 0.0 ? step * std::round(x / step) : x;
    if (time >= next_board) {
      next_board += period;
      if (is_on_board) {
        const float position[3] = {(float)read, 0.0f, 0.0f};
        loop.tick(position, force);
        motor = force[0];
      }
    }
    if (time >= next_host) {
      next_host += host_period;
      seen.push_back(std::make_pair(time + 0.5 * delay, read));
      last = newest;
      while (!seen.empty() && seen.front().first <= time) {
        newest = seen.front().second;
        seen.pop_front();
      }
      const double depth = newest < 0.0 ? -newest : 0.0;
      const double wanted = std::min(stiffness * depth, numbers[3]);
      sent.push_back(std::make_pair(time + 0.5 * delay, is_on_board ? newest : wanted));
    }
    while (!sent.empty() && sent.front().first <= time) {
      const double news = sent.front().second;
      sent.pop_front();
      if (!is_on_board) {
        motor = news;
        continue;
      }
      HbShown shown;
      memset(&shown, 0, sizeof shown);
      shown.position[0] = (float)(news > 0.0 ? news : 0.0);
      shown.velocity[0] = (float)((newest - last) / host_period);
      shown.has_velocity = true;
      shown.planes = 1;
      shown.plane[0].normal[0] = 1.0f;
      shown.plane[0].gap = shown.position[0];
      loop.show(shown, false);
    }
    // a tap, then a push that stays
    const double wanted = motor - push * (time < 0.5 ? 3.0 : 1.0) - b * v;
    const double stop = mass * std::fabs(v + substep * wanted / mass) / substep;
    const double drag = std::min(friction, stop);
    v += substep * wanted / mass;
    v -= (v > 0.0 ? 1.0 : -1.0) * substep * drag / mass;
    x += substep * v;
    given += (motor - b * v) * v * substep;
    found[1] = std::max(found[1], given);
    found[3] = std::max(found[3], motor);
    if (time > duration - 0.5) {
      low = std::min(low, x);
      high = std::max(high, x);
    }
  }
  found[0] = high - low;
  found[2] = -x;
}

// A whole board, which a host knows by its frames alone. numbers: damping, friction, step, largest
// force and speed, mass, time from a position to its force; and damping, inertia and largest torque of
// rotation. A device that only turns knows those of lines not. With HB_POSE its loop renders rotation.
Board* board_new(int axes, float period, const float* numbers) {
  HbSheet sheet;
  memset(&sheet, 0, sizeof sheet);
  sheet.axes = (uint16_t)(axes & ~HB_POSE);
  sheet.rate = 1000.0f;
  sheet.damping = numbers[0];
  sheet.friction = numbers[1];
  sheet.resolution = numbers[2];
  sheet.force_limit = numbers[3];
  sheet.speed_limit = numbers[4];
  sheet.mass = numbers[5];
  sheet.rotational_damping = numbers[7];
  sheet.rotational_inertia = numbers[8];
  sheet.torque_limit = numbers[9];
  if ((axes & (HB_X | HB_Y | HB_Z)) == 0) {
    sheet.damping = sheet.mass = sheet.friction = sheet.resolution = sheet.force_limit = NAN;
  }
  sheet.delay = period;
  sheet.loop_delay = numbers[6];
  sheet.name = "board";
  return new Board(sheet, period, (axes & HB_POSE) != 0);
}

int board_receive(Board* board, const unsigned char* frame, unsigned now_us) {
  return board->turns ? board->poses.receive(frame, now_us) : board->lines.receive(frame, now_us);
}

int board_answer(Board* board, unsigned char* frame) {
  return board->turns ? board->poses.answer(frame) : board->lines.answer(frame);
}

// pose: position and quaternion, or an angle in the place of a position
void board_state(Board* board, const float* pose, int status, unsigned now_us,
                 unsigned char* frame) {
  HbMotion motion;
  memset(&motion, 0, sizeof motion);
  memcpy(motion.position, pose, 12);
  motion.status = (uint8_t)status;
  if (board->turns) {
    const float none[4] = {1.0f, 0.0f, 0.0f, 0.0f};
    hb_turn(none, pose + 3, motion.rotation);
    board->poses.state(motion, now_us, frame);
    return;
  }
  if (board->lines.turns()) memcpy(motion.rotation, pose, 12);
  board->lines.state(motion, now_us, frame);
}

int board_more(Board* board, unsigned char* frame) {
  return board->turns ? board->poses.more(frame) : board->lines.more(frame);
}

void board_heat(Board* board, float temperature, float limit) {
  board->lines.set_temperature(temperature, limit);
}

// wrench: force and torque
void board_tick(Board* board, const float* pose, unsigned now_us, float* wrench) {
  if (board->turns) {
    board->poses.tick(pose, pose + 3, now_us, wrench, wrench + 3);
  } else {
    board->lines.tick(pose, now_us, wrench);
  }
}
}

namespace {

typedef std::mt19937 Draws;

// Turns a quaternion by a rotation vector, in double precision.
void turn_by(const double turn[3], double q[4]) {
  const double angle = std::sqrt(turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2]);
  const double factor = angle > 1e-12 ? std::sin(0.5 * angle) / angle : 0.5;
  const double w = std::cos(0.5 * angle), x = factor * turn[0], y = factor * turn[1];
  const double z = factor * turn[2], a = q[0], b = q[1], c = q[2], d = q[3];
  q[0] = w * a - x * b - y * c - z * d;
  q[1] = w * b + x * a + y * d - z * c;
  q[2] = w * c - x * d + y * a + z * b;
  q[3] = w * d + x * c - y * b + z * a;
}

// A hand that turns a handle as it likes, and a program that shows a tool at any orientation.
struct TurningHand {
  Draws& rng;
  std::normal_distribution<double> normal;
  std::uniform_real_distribution<double> uniform;
  double rotation[4], velocity[3], period, b, size;
  float torque[3];
  int kind, program;
  double phase;

  TurningHand(Draws& draws, const double* numbers) : rng(draws), period(numbers[0]), phase(0.0) {
    Draws own(rng);  // the draws for lines stay what they are
    b = numbers[6] * (numbers[8] * period / 2.0 + numbers[9]);
    kind = (int)(uniform(own) * 5.0);
    program = (int)(uniform(own) * 4.0);
    size = std::pow(10.0, -3.0 + 3.5 * uniform(own));
    for (int i = 0; i < 3; i++) velocity[i] = torque[i] = 0.0f;
    for (int i = 0; i < 4; i++) rotation[i] = i == 0;
  }

  // Turns the handle for a period; returns the energy in J that the hand gains.
  double move(double direction) {
    double turn[3], gained = 0.0;
    phase += 0.01 + 3.0 * uniform(rng);
    for (int i = 0; i < 3; i++) {
      const double best = torque[i] * period / (2.0 * b);
      const double other = torque[(i + 1) % 3] * period / (2.0 * b);
      velocity[i] += 0.3 * normal(rng) - 0.05 * velocity[i];
      turn[i] = kind == 0   ? best * uniform(rng) * 2.0
                : kind == 1 ? 1e-2 * size * velocity[i]
                : kind == 2 ? best + std::sin(phase) * other  // around its axis
                : direction > 0.0 ? best
                : kind == 3       ? -0.5 * best
                                  : 1e-2 * size * (i == 0 ? 1.0 : normal(rng));
      gained += torque[i] * turn[i] - b / period * turn[i] * turn[i];
    }
    turn_by(turn, rotation);
    return gained;
  }

  // Shows the tool anywhere.
  void aim(double direction, HbShown& shown) {
    double q[4], turn[3];
    for (int i = 0; i < 3; i++) {
      turn[i] = program == 0   ? size * normal(rng)
                : program == 1 ? -direction * size
                : program == 2 ? 10.0 * size * normal(rng)
                               : size * direction * (i == 0);
      shown.turning[i] = (float)(normal(rng) * size * 100.0);
    }
    for (int i = 0; i < 4; i++) q[i] = program == 2 ? i == 0 : rotation[i];
    turn_by(turn, q);
    for (int i = 0; i < 4; i++) shown.rotation[i] = (float)q[i];
  }
};

// Lets a hand move a device of damping b = K T/2 + B, in each period at a constant velocity, while a
// host shows anything, late, out of order or not at all, changes gains and credit's use, and either
// restarts. Returns the most energy in J that the hand has gained beyond what blur may give:
//
//   sum f . dh - (b/T) |dh|^2 - (step/2) sum |df|
//
// and, of a device that turns, as much of torque and rotation, with a damping of its own.
//
// numbers: T, K, B, F, E, step of the encoder, share of b that the device has, 1 to trust each show,
// and K, B and F of rotations
template <bool TURNS>
double attacked(unsigned seed, const double* numbers, long ticks) {
  Draws rng(seed);
  std::normal_distribution<double> normal;
  std::uniform_real_distribution<double> uniform;
  const double period = numbers[0], step = numbers[5];
  const float strongest[3] = {(float)numbers[1], (float)numbers[2], (float)numbers[3]};
  const double b = numbers[6] * (numbers[1] * period / 2.0 + numbers[2]);
  float choice[10] = {strongest[0], strongest[1], strongest[2], (float)numbers[4], 0.0f,
                      (float)(period * (1.0 + 50.0 * uniform(rng))), 0.05f, (float)numbers[8],
                      (float)numbers[9], (float)numbers[10]};
  TurningHand turning(rng, numbers);
  if (numbers[7] > 0.0) choice[3] = choice[4] = 1e3f;
  HbLoopOf<TURNS>* loop = new HbLoopOf<TURNS>((float)period);
  loop->set(setting_of(choice, 1));
  double hand[3] = {0.0, 0.0, 0.0}, velocity[3] = {0.0, 0.0, 0.0}, gained = 0.0, most = 0.0;
  double work = 0.0, changes = 0.0;
  float force[3] = {0.0f, 0.0f, 0.0f}, last[3] = {0.0f, 0.0f, 0.0f};
  std::vector<Message> waiting;
  const int kind = (int)(uniform(rng) * 4.0), program = (int)(uniform(rng) * 4.0);
  const double size = std::pow(10.0, -4.5 + 3.0 * uniform(rng));
  const double interval = std::pow(10.0, 3.0 * uniform(rng)), late = 100.0 * uniform(rng);
  long due = 0, turn = 0;
  double direction = 1.0;
  for (long tick = 0; tick < ticks; tick++) {
    if (tick >= turn) {
      turn = tick + (long)(std::pow(10.0, 1.0 + 2.5 * uniform(rng)));
      direction = uniform(rng) < 0.5 ? -1.0 : 1.0;
    }
    for (int i = 0; i < 3; i++) {
      double move = 0.0;
      const double best = force[i] * period / (2.0 * b);
      if (kind == 0) {
        move = best * uniform(rng) * 2.0;  // gives way
      } else if (kind == 1) {
        velocity[i] += 0.3 * normal(rng) - 0.05 * velocity[i];
        move = 1e-2 * size * velocity[i];
      } else if (direction > 0.0) {
        move = best;
      } else {
        move = kind == 2 ? -0.5 * best : 1e-2 * size * (i == 0 ? 1.0 : normal(rng));
      }
      hand[i] += move;
      gained += force[i] * move - b / period * move * move;
    }
    if (TURNS) gained += turning.move(direction);
    most = std::max(most, gained - 0.5 * step * changes);
    if (tick >= due) {
      due = tick + 1 + (long)(interval * 2.0 * uniform(rng));
      Message message;
      memset(&message, 0, sizeof message);
      message.due = tick + (long)(late * uniform(rng));
      message.kind = uniform(rng) < 0.1;
      message.placed = uniform(rng) < 0.02;
      if (message.kind == 1) {
        for (int k = 0; k < 3; k++) choice[k] = strongest[k] * (float)uniform(rng);
        for (int k = 0; TURNS && k < 3; k++) choice[7 + k] = (float)(numbers[8 + k] * uniform(rng));
        message.setting = setting_of(choice, uniform(rng) < 0.8);
      }
      HbShown& shown = message.shown;
      shown.has_velocity = uniform(rng) < 0.5;
      for (int i = 0; i < 3; i++) {
        const double place = program == 0   ? hand[i] + size * normal(rng)
                             : program == 1 ? hand[i] - direction * size
                             : program == 2 ? 10.0 * size * normal(rng)
                                            : hand[i] + size * direction * (i == 0);
        shown.position[i] = (float)place;
        shown.velocity[i] = (float)(normal(rng) * size * 100.0);
      }
      if (TURNS) turning.aim(direction, shown);
      if (program != 1) work = std::max(0.0, work + 1e-5 * normal(rng));
      shown.work = (HbEnergy)(1e12 * work);
      shown.planes = (uint8_t)(uniform(rng) * (HB_PLANES + 1));
      for (int k = 0; k < shown.planes; k++) {
        HbPlane& plane = shown.plane[k];
        double norm = 0.0;
        for (int i = 0; i < 3; i++) {
          plane.normal[i] = (float)normal(rng);
          norm += plane.normal[i] * plane.normal[i];
        }
        for (int i = 0; i < 3; i++) plane.normal[i] /= (float)std::sqrt(norm);
        plane.gap = (float)(size * uniform(rng));
      }
      if (uniform(rng) > 0.2) waiting.push_back(message);  // or it is lost
    }
    for (size_t k = 0; k < waiting.size();) {
      if (waiting[k].due > tick) {
        k++;
        continue;
      }
      if (waiting[k].kind == 1) {
        loop->set(waiting[k].setting);
      } else {
        loop->show(waiting[k].shown, waiting[k].placed);
      }
      waiting.erase(waiting.begin() + (long)k);
    }
    if (uniform(rng) < 1e-4) {  // the board restarts
      delete loop;
      loop = new HbLoopOf<TURNS>((float)period);
      loop->set(setting_of(choice, 1));
      most = std::max(most, gained - 0.5 * step * changes);
      gained -= numbers[4];  // a credit of its own
    }
    float position[3];
    for (int i = 0; i < 3; i++) {
      position[i] = (float)(step > 0.0 ? step * std::round(hand[i] / step) : hand[i]);
    }
    float rotation[4];
    for (int i = 0; i < 4; i++) rotation[i] = (float)turning.rotation[i];
    loop->tick(position, rotation, force, turning.torque);
    for (int i = 0; i < 3; i++) {
      changes += std::fabs(force[i] - last[i]);
      last[i] = force[i];
    }
  }
  delete loop;
  return most;
}
}  // namespace

extern "C" double attack(unsigned seed, const double* numbers, int turns, long ticks) {
  return turns ? attacked<true>(seed, numbers, ticks) : attacked<false>(seed, numbers, ticks);
}

// Turns a handle of an isotropic inertia and damping in a hand that is a torsion spring, about a
// shown tool that stands still, at a large twist, with a ledger of its own: in substeps of T/20. A
// knock sets it wobbling about its twist. Returns the most energy in J that the motors gave beyond what
// b burned, what the tool took and the coupling's spring holds, and the largest speed in rad/s at the
// end.
//
// numbers: T, K, B, F of rotations, inertia, b, stiffness of the hand, twist in rad, time t from a
// position to its torque
extern "C" void wobble(const double* numbers, double* found) {
  const double period = numbers[0], inertia = numbers[4], b = numbers[5], hand = numbers[6];
  const double substep = period / 20.0;
  const long late = std::lround(numbers[8] / substep), count = std::lround(1.0 / substep);
  const float setting[10] = {0.0f, 0.0f, 0.0f, 100.0f, 100.0f, (float)period, 10.0f,
                             (float)numbers[1], (float)numbers[2], (float)numbers[3]};
  HbPoseLoop loop((float)period);
  loop.set(setting_of(setting, 1));
  HbShown shown;
  memset(&shown, 0, sizeof shown);
  shown.rotation[0] = 1.0f;
  shown.has_velocity = true;
  double q[4] = {1.0, 0.0, 0.0, 0.0}, given = 0.0;
  double speed[3] = {0.0, 0.3, 0.0}, aim[4] = {1.0, 0.0, 0.0, 0.0};
  const double twist[3] = {0.0, 0.0, numbers[7]};
  turn_by(twist, q);
  turn_by(twist, aim);
  // the hand's spring pulls so far beyond that it holds the twist
  const double held = std::min(numbers[1] * numbers[7], numbers[3]);
  const double beyond[3] = {0.0, 0.0, held / hand};
  turn_by(beyond, aim);
  float force[3], torque[3] = {0.0f, 0.0f, 0.0f}, next[3] = {0.0f, 0.0f, 0.0f};
  found[0] = found[1] = 0.0;
  for (long step = 0; step < count; step++) {
    if (step % 20 == 0) {
      if (step % 200 == 0) loop.show(shown, false);
      const float position[3] = {0.0f, 0.0f, 0.0f};
      const float rotation[4] = {(float)q[0], (float)q[1], (float)q[2], (float)q[3]};
      loop.tick(position, rotation, force, next);
      float stretch[3];
      hb_turn(loop.report().tool_turn, rotation, stretch);
      const double angle = std::sqrt(stretch[0] * stretch[0] + stretch[1] * stretch[1] +
                                     stretch[2] * stretch[2]);
      const double bent = std::min(angle, numbers[3] / numbers[1]);
      const double energy = numbers[1] * bent * (angle - 0.5 * bent);
      const HbReport& report = loop.report();
      if (report.share == 1.0f) {
        found[0] = std::max(found[0], given + 1e-12 * (double)report.passed + energy);
      }
    }
    if (step % 20 == late % 20) memcpy(torque, next, sizeof torque);
    double turn[3], pull[3] = {0.0, 0.0, 0.0};
    const float from[4] = {(float)q[0], (float)q[1], (float)q[2], (float)q[3]};
    const float to[4] = {(float)aim[0], (float)aim[1], (float)aim[2], (float)aim[3]};
    float away[3];
    hb_turn(from, to, away);
    for (int i = 0; i < 3; i++) {
      pull[i] = hand * away[i] - b * speed[i] + torque[i];
      speed[i] += substep * pull[i] / inertia;
      turn[i] = substep * speed[i];
      given += (torque[i] - b * speed[i]) * turn[i];
    }
    turn_by(turn, q);
    const double now = std::sqrt(speed[0] * speed[0] + speed[1] * speed[1] + speed[2] * speed[2]);
    if (step > count * 9 / 10) found[1] = std::max(found[1], now);
  }
}
