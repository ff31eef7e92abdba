// C entry points to the loop on the board, for ctypes; and a hand that tries to gain energy from it.
#include <deque>
#include <random>
#include <utility>
#include <vector>

static void noInterrupts() {}
static void interrupts() {}
#include "hb_board.h"

namespace {

HbSetting setting_of(const float* numbers, int is_enabled) {
  HbSetting setting;
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

struct Message {
  long due;
  int kind;  // 0: shown, 1: setting
  bool placed;
  HbShown shown;
  HbSetting setting;
};

}  // namespace

extern "C" {

HbLoop* loop_new(float period) { return new HbLoop(period); }

void loop_delete(HbLoop* loop) { delete loop; }

void loop_set(HbLoop* loop, const float* numbers, int is_enabled) {
  loop->set(setting_of(numbers, is_enabled));
}

void loop_show(HbLoop* loop, const float* numbers, double work, int planes, int has_velocity,
               int placed) {
  HbShown shown;
  memset(&shown, 0, sizeof shown);
  memcpy(shown.position, numbers, 12);
  memcpy(shown.velocity, numbers + 3, 12);
  shown.work = (HbEnergy)(1e12 * work);
  shown.planes = (uint8_t)planes;
  shown.has_velocity = has_velocity != 0;
  for (int k = 0; k < planes; k++) {
    memcpy(shown.plane[k].normal, numbers + 6 + 4 * k, 12);
    shown.plane[k].gap = numbers[9 + 4 * k];
  }
  loop->show(shown, placed != 0);
}

void loop_tick(HbLoop* loop, const float* position, float* force) { loop->tick(position, force); }

void loop_report(const HbLoop* loop, double* works, float* poses) {
  const HbReport& report = loop->report();
  works[0] = 1e-12 * (double)report.passed;
  works[1] = 1e-12 * (double)report.tank;
  works[2] = 1e-6 * (double)report.changes;
  works[3] = report.held_back;
  works[4] = report.share;
  memcpy(poses, report.position, 12);
  memcpy(poses + 3, report.tool, 12);
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
  const float setting[7] = {(float)stiffness, (float)numbers[2], (float)numbers[3], 0.0f, 0.0f,
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
// force and speed, mass, time from a position to its force.
HbBoard* board_new(int axes, float period, const float* numbers) {
  HbSheet sheet;
  memset(&sheet, 0, sizeof sheet);
  sheet.axes = (uint16_t)axes;
  sheet.rate = 1000.0f;
  sheet.damping = numbers[0];
  sheet.friction = numbers[1];
  sheet.resolution = numbers[2];
  sheet.force_limit = numbers[3];
  sheet.speed_limit = numbers[4];
  sheet.mass = numbers[5];
  sheet.torque_limit = sheet.rotational_damping = sheet.rotational_inertia = NAN;
  if ((axes & (HB_X | HB_Y | HB_Z)) == 0) {
    sheet.rotational_damping = sheet.damping;
    sheet.rotational_inertia = sheet.mass;
    sheet.torque_limit = sheet.force_limit;
    sheet.damping = sheet.mass = sheet.friction = sheet.resolution = sheet.force_limit = NAN;
  }
  sheet.delay = period;
  sheet.loop_delay = numbers[6];
  sheet.name = "board";
  return new HbBoard(sheet, period);
}

void board_delete(HbBoard* board) { delete board; }

int board_receive(HbBoard* board, const unsigned char* frame, unsigned now_us) {
  return board->receive(frame, now_us);
}

int board_answer(HbBoard* board, unsigned char* frame) { return board->answer(frame); }

void board_state(HbBoard* board, const float* position, int status, unsigned now_us,
                 unsigned char* frame) {
  HbMotion motion;
  memset(&motion, 0, sizeof motion);
  memcpy(motion.position, position, 12);
  if (board->turns()) memcpy(motion.rotation, position, 12);
  motion.status = (uint8_t)status;
  board->state(motion, now_us, frame);
}

void board_heat(HbBoard* board, float temperature, float limit) {
  board->set_temperature(temperature, limit);
}

void board_tick(HbBoard* board, const float* position, unsigned now_us, float* force) {
  board->tick(position, now_us, force);
}

// Lets a hand move a device of damping b = K T/2 + B, in each period at a constant velocity, while a
// host shows anything, late, out of order or not at all, changes gains and credit's use, and either
// restarts. Returns the most energy in J that the hand has gained beyond what blur may give:
//
//   sum f . dh - (b/T) |dh|^2 - (step/2) sum |df|
//
// numbers: T, K, B, F, E, step of the encoder, share of b that the device has, 1 to trust each show
double attack(unsigned seed, const double* numbers, long ticks) {
  std::mt19937 rng(seed);
  std::normal_distribution<double> normal;
  std::uniform_real_distribution<double> uniform;
  const double period = numbers[0], step = numbers[5];
  const float strongest[3] = {(float)numbers[1], (float)numbers[2], (float)numbers[3]};
  const double b = numbers[6] * (numbers[1] * period / 2.0 + numbers[2]);
  float choice[7] = {strongest[0], strongest[1], strongest[2], (float)numbers[4], 0.0f,
                     (float)(period * (1.0 + 50.0 * uniform(rng))), 0.05f};
  if (numbers[7] > 0.0) choice[3] = choice[4] = 1e3f;
  HbLoop* loop = new HbLoop((float)period);
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
      loop = new HbLoop((float)period);
      loop->set(setting_of(choice, 1));
      most = std::max(most, gained - 0.5 * step * changes);
      gained -= numbers[4];  // a credit of its own
    }
    float position[3];
    for (int i = 0; i < 3; i++) {
      position[i] = (float)(step > 0.0 ? step * std::round(hand[i] / step) : hand[i]);
    }
    loop->tick(position, force);
    for (int i = 0; i < 3; i++) {
      changes += std::fabs(force[i] - last[i]);
      last[i] = force[i];
    }
  }
  delete loop;
  return most;
}
}
