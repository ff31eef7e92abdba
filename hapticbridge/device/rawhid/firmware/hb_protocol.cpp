// See hb_protocol.h and ../../rawhid.md.
#include "hb_protocol.h"

#include <string.h>

namespace {

const size_t CRC_AT = HB_FRAME_BYTES - 2;
const float LARGEST = 1e9f;  // of gains and times, in SI units

// Byte by byte, so that the frame is little-endian on any processor.
void put16(uint8_t* at, uint16_t value) {
  at[0] = (uint8_t)value;
  at[1] = (uint8_t)(value >> 8);
}

void put32(uint8_t* at, uint32_t value) {
  put16(at, (uint16_t)value);
  put16(at + 2, (uint16_t)(value >> 16));
}

uint16_t get16(const uint8_t* at) { return (uint16_t)(at[0] | (uint16_t)at[1] << 8); }

void put_float(uint8_t* at, float value) {
  uint32_t bits;
  memcpy(&bits, &value, 4);
  put32(at, bits);
}

// The bits of a float32, so that "finite" holds under -ffast-math too.
uint32_t float_bits(const uint8_t* at) { return get16(at) | (uint32_t)get16(at + 2) << 16; }

bool is_finite(uint32_t bits) { return (bits & 0x7F800000u) != 0x7F800000u; }

void put_energy(uint8_t* at, HbEnergy value) {
  put32(at, (uint32_t)value);
  put32(at + 4, (uint32_t)((uint64_t)value >> 32));
}

HbEnergy get_energy(const uint8_t* at) {
  return (HbEnergy)(float_bits(at) | (uint64_t)float_bits(at + 4) << 32);
}

bool are_finite(const uint8_t* at, int count) {
  for (int i = 0; i < count; i++) {
    if (!is_finite(float_bits(at + 4 * i))) return false;
  }
  return true;
}

float get_float(const uint8_t* at) {
  uint32_t bits = float_bits(at);
  float value;
  memcpy(&value, &bits, 4);
  return value;
}

void get_vector(const uint8_t* at, float vector[3]) {
  for (int i = 0; i < 3; i++) vector[i] = get_float(at + 4 * i);
}

void put_vector(uint8_t* at, const float vector[3]) {
  for (int i = 0; i < 3; i++) put_float(at + 4 * i, vector[i]);
}

// Reads stiffness, damping and level; false if one pushes the hand or overflows.
bool get_gains(const uint8_t* at, HbGains& gains) {
  if (!are_finite(at, 3)) return false;
  for (int i = 0; i < 3; i++) {
    if (get_float(at + 4 * i) < 0.0f || get_float(at + 4 * i) > LARGEST) return false;
  }
  gains.stiffness = get_float(at);
  gains.damping = get_float(at + 4);
  gains.level = get_float(at + 8);
  return true;
}

void get_plane(const uint8_t* at, HbPlane& plane) {
  get_vector(at, plane.normal);
  plane.gap = get_float(at + 12);
}

// Reads a vector of 16-bit numbers in a unit.
void get_short(const uint8_t* at, float unit, float vector[3]) {
  for (int i = 0; i < 3; i++) vector[i] = unit * (float)(int16_t)get16(at + 2 * i);
}

// Reads a shown tool; false if a number is not finite.
bool get_tool(const uint8_t* frame, HbShown& shown) {
  if (!are_finite(frame + 8, 6) || !are_finite(frame + 40, 4)) return false;
  get_vector(frame + 8, shown.position);
  get_vector(frame + 20, shown.velocity);
  shown.work = get_energy(frame + 32);
  get_plane(frame + 40, shown.plane[0]);
  return true;
}

// Reads a shown tool with its rotation; false if a number is not finite.
bool get_pose(const uint8_t* frame, HbShown& shown) {
  if (!are_finite(frame + 8, 6) || !are_finite(frame + 58, 1)) return false;
  const float none[4] = {1.0f, 0.0f, 0.0f, 0.0f};
  float turn[3];
  get_vector(frame + 8, shown.position);
  get_vector(frame + 20, turn);
  hb_turned(turn, none, shown.rotation);
  shown.work = get_energy(frame + 32);
  get_short(frame + 40, HB_SPEED_STEP, shown.velocity);
  get_short(frame + 46, HB_TURN_STEP, shown.turning);
  get_short(frame + 52, 1.0f / 32767.0f, shown.plane[0].normal);
  shown.plane[0].gap = get_float(frame + 58);
  return true;
}

void begin(uint8_t* frame, uint8_t kind, uint8_t option, uint16_t sequence) {
  memset(frame, 0, HB_FRAME_BYTES);
  frame[0] = HB_MAGIC;
  frame[1] = HB_VERSION;
  frame[2] = kind;
  frame[3] = option;
  put16(frame + 4, sequence);
}

void seal(uint8_t* frame) { put16(frame + CRC_AT, hb_crc16(frame, CRC_AT)); }

}  // namespace

uint16_t hb_crc16(const uint8_t* data, size_t count) {
  uint16_t crc = 0xFFFF;
  for (size_t i = 0; i < count; i++) {
    // one byte at once, without a table: 62 bytes take about 0.15 ms on an AVR at 16 MHz
    uint8_t x = (uint8_t)(crc >> 8) ^ data[i];
    x = (uint8_t)(x ^ x >> 4);
    crc = (uint16_t)((uint16_t)(crc << 8) ^ (uint16_t)((uint16_t)x << 12) ^
                     (uint16_t)((uint16_t)x << 5) ^ x);
  }
  return crc;
}

HbCommand::HbCommand()
    : received_us(0), watchdog_us(0), is_enabled(false), has_expired(false), is_unfit(false) {
  memset(&commanded, 0, sizeof commanded);
}

HbWrench HbCommand::wrench(uint32_t now_us) {
  // unsigned, so correct when the clock wraps; an expired command stays so until the next frame
  if (!has_expired && (uint32_t)(now_us - received_us) >= watchdog_us) has_expired = true;
  if (is_enabled && !has_expired && !is_unfit) return commanded;
  HbWrench none;
  memset(&none, 0, sizeof none);
  return none;
}

HbDevice::HbDevice(const HbSheet& sheet)
    : sheet_(sheet),
      is_loop_(false),
      planes_sequence_(0),
      sequence_(0),
      echo_(0),
      asked_sequence_(0),
      asked_page_(-1),
      is_damaged_(false),
      fill_(0) {
  memset(&order_, 0, sizeof order_);
}

bool HbDevice::receive(const uint8_t frame[HB_FRAME_BYTES], uint32_t now_us) {
  if (frame[0] != HB_MAGIC || get16(frame + CRC_AT) != hb_crc16(frame, CRC_AT)) {
    is_damaged_ = true;
    return false;
  }
  order_.kind = HbOrder::NONE;
  if (frame[1] != HB_VERSION) return false;
  if (frame[2] == HB_KIND_ASK) {
    asked_page_ = frame[3];
    asked_sequence_ = get16(frame + 4);
  } else if (frame[2] == HB_KIND_FORCE) {
    if (!are_finite(frame + 8, 7)) return false;
    uint16_t watchdog_ms = get16(frame + 6);
    if (watchdog_ms > HB_LONGEST_WATCHDOG_MS) watchdog_ms = HB_LONGEST_WATCHDOG_MS;
    get_vector(frame + 8, command_.commanded.force);
    get_vector(frame + 20, command_.commanded.torque);
    command_.commanded.grip = get_float(frame + 32);
    echo_ = get16(frame + 4);
    command_.is_enabled = (frame[3] & HB_OPTION_ENABLE) != 0;
    command_.watchdog_us = 1000u * watchdog_ms;
    command_.received_us = now_us;
    command_.has_expired = false;
    is_loop_ = false;
    memset(&order_.setting, 0, sizeof order_.setting);  // a later host has its own
  } else if (!take_order(frame)) {
    return false;
  }
  is_damaged_ = false;
  return true;
}

bool HbDevice::receive_byte(uint8_t byte, uint32_t now_us) {
  if (fill_ == 0 && byte != HB_MAGIC) {
    is_damaged_ = true;
    return false;
  }
  line_[fill_++] = byte;
  if (fill_ < HB_FRAME_BYTES) return false;
  if (receive(line_, now_us)) {
    fill_ = 0;
    return true;
  }
  uint8_t next = 1;
  while (next < HB_FRAME_BYTES && line_[next] != HB_MAGIC) next++;
  fill_ = (uint8_t)(HB_FRAME_BYTES - next);
  memmove(line_, line_ + next, fill_);
  return false;
}

bool HbDevice::answer(uint8_t frame[HB_FRAME_BYTES]) {
  const int16_t page = asked_page_;
  asked_page_ = -1;
  if (page == 0) {
    begin(frame, HB_KIND_SHEET, 0, asked_sequence_);
    put16(frame + 6, sheet_.axes);
    const float numbers[] = {sheet_.rate,
                             sheet_.mass,
                             sheet_.damping,
                             sheet_.rotational_inertia,
                             sheet_.rotational_damping,
                             sheet_.friction,
                             sheet_.resolution,
                             sheet_.force_limit,
                             sheet_.torque_limit,
                             sheet_.speed_limit,
                             sheet_.delay,
                             sheet_.loop_rate,
                             sheet_.loop_delay};
    for (size_t i = 0; i < sizeof numbers / sizeof *numbers; i++) {
      put_float(frame + 8 + 4 * i, numbers[i]);
    }
  } else if (page == 1) {
    begin(frame, HB_KIND_SHEET, 1, asked_sequence_);
    const size_t length = strlen(sheet_.name);
    memcpy(frame + 8, sheet_.name, length < HB_NAME_BYTES ? length : HB_NAME_BYTES);
  } else if (page == 2 && (sheet_.axes & HB_GRIP) != 0) {
    begin(frame, HB_KIND_SHEET, 2, asked_sequence_);
    const HbGrip& grip = *sheet_.grip;
    const float numbers[] = {grip.mass,        grip.damping,     grip.friction, grip.resolution,
                             grip.force_limit, grip.speed_limit, grip.travel};
    for (size_t i = 0; i < sizeof numbers / sizeof *numbers; i++) {
      put_float(frame + 8 + 4 * i, numbers[i]);
    }
  } else {
    return false;
  }
  seal(frame);
  return true;
}

// Takes a frame for a loop on the board; returns false for another one.
bool HbDevice::take_order(const uint8_t frame[HB_FRAME_BYTES]) {
  HbShown& shown = order_.shown;
  const uint16_t sequence = get16(frame + 4);
  if (frame[2] == HB_KIND_PLANES) {
    if (!are_finite(frame + 8, 8)) return false;
    for (int k = 1; k < HB_PLANES; k++) get_plane(frame + 16 * k - 8, shown.plane[k]);
    planes_sequence_ = sequence;
    return true;
  }
  const bool is_posed = (sheet_.axes & HB_POSE) != 0;
  if (frame[2] == (is_posed ? HB_KIND_POSE : HB_KIND_SHOW)) {
    if (is_loop_ && (int16_t)(sequence - echo_) <= 0) return false;  // overtaken
    if (!(is_posed ? get_pose(frame, shown) : get_tool(frame, shown))) return false;
    shown.planes = frame[3] / HB_OPTION_PLANE;
    const uint8_t known = planes_sequence_ == sequence ? HB_PLANES : 1;
    if (shown.planes > known) shown.planes = known;
    shown.has_velocity = (frame[3] & HB_OPTION_HAS_VELOCITY) != 0;
    order_.is_placed = (frame[3] & HB_OPTION_IS_PLACED) != 0;
    order_.setting.is_enabled = (frame[3] & HB_OPTION_ENABLE) != 0;
    order_.setting.patience = 1e-3f * get16(frame + 6);
    echo_ = sequence;
    order_.kind = HbOrder::SHOW;
  } else if (frame[2] == HB_KIND_SETTING) {
    HbGains gains, turn_gains, times;
    if (!get_gains(frame + 8, gains) || !get_gains(frame + 36, turn_gains)) return false;
    if (!get_gains(frame + 16, times)) return false;  // F, energy under way and fade
    HbSetting& setting = order_.setting;
    setting.gains = gains;
    setting.turn_gains = turn_gains;
    setting.passing = get_float(frame + 20);
    setting.fade = get_float(frame + 24);
    setting.credit = get_energy(frame + 28);
    order_.kind = HbOrder::SET;
  } else {
    return false;
  }
  if (!is_loop_) {
    is_loop_ = true;
    command_.is_enabled = false;
    if (order_.kind == HbOrder::SET) echo_ = (uint16_t)(sequence - 1);
  }
  return true;
}

void HbDevice::begin_state(uint8_t kind, const HbMotion& motion, uint32_t now_us,
                           uint8_t frame[HB_FRAME_BYTES]) {
  command_.is_unfit = (motion.status & (HB_FAULT | HB_NOT_READY)) != 0;
  wrench(now_us);  // updates command_.has_expired
  uint8_t status = motion.status & (HB_SATURATED | HB_FAULT_DRIVER | HB_NOT_READY);
  if (!is_loop_ && command_.is_enabled) status |= HB_ENABLED;
  if (!is_loop_ && command_.has_expired) status |= HB_WATCHDOG;
  if (is_damaged_) status |= HB_DAMAGED;
  begin(frame, kind, status, ++sequence_);
  put16(frame + 6, motion.buttons);
  put32(frame + 8, now_us);
  put_vector(frame + 12, motion.position);
  put16(frame + 60, echo_);
}

void HbDevice::loop_state(const HbMotion& motion, const HbReport& report, uint32_t now_us,
                          uint8_t frame[HB_FRAME_BYTES]) {
  begin_state(HB_KIND_LOOP, motion, now_us, frame);
  if (report.share > 0.0f) frame[3] |= HB_ENABLED;
  if (report.is_faulty && (frame[3] & HB_FAULT) == 0) frame[3] |= HB_FAULT_ENCODER;
  put_vector(frame + 12, turns() ? motion.rotation : motion.position);
  put_vector(frame + 24, turns() ? motion.angular_velocity : motion.velocity);
  put_vector(frame + 36, report.force);
  put_energy(frame + 48, report.passed);
  put_float(frame + 56, 1e-12f * (float)report.tank);
  seal(frame);
}

void HbDevice::loop_turn(const HbMotion& motion, const HbReport& report,
                         uint8_t frame[HB_FRAME_BYTES]) {
  begin(frame, HB_KIND_LOOP_TURN, 0, sequence_);
  put_float(frame + 8, report.rotation[0]);
  put_vector(frame + 12, report.rotation + 1);
  put_vector(frame + 24, motion.angular_velocity);
  put_vector(frame + 36, report.torque);
  seal(frame);
}

void HbDevice::loop_report(const HbReport& report, const HbPace& pace,
                           uint8_t frame[HB_FRAME_BYTES]) {
  begin(frame, HB_KIND_REPORT, 0, sequence_);
  put_energy(frame + 8, report.changes);
  put_energy(frame + 16, order_.shown.work);
  put32(frame + 24, report.held_back);
  put32(frame + 28, pace.ticks);
  put32(frame + 32, pace.missed);
  put_float(frame + 36, report.share);
  put_float(frame + 40, pace.temperature);
  put_vector(frame + 44, report.tool);
  put_float(frame + 56, pace.temperature_limit);
  seal(frame);
}

void HbDevice::state(const HbMotion& motion, uint32_t now_us, uint8_t frame[HB_FRAME_BYTES]) {
  begin_state(HB_KIND_STATE, motion, now_us, frame);
  put_vector(frame + 24, motion.rotation);
  put_vector(frame + 36, motion.velocity);
  put_vector(frame + 48, motion.angular_velocity);
  if (sheet_.axes & HB_GRIP) {
    put_float(frame + 48, motion.grip_position);
    put_float(frame + 52, motion.grip_speed);
    put_float(frame + 56, 0.0f);
  }
  seal(frame);
}
