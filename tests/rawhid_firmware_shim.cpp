// C entry points to the firmware's protocol, for ctypes; and, with SKETCH, the whole sketch on
// hardware that is only variables.
#include <cmath>
#include <cstring>
#include <deque>
#include <vector>

#ifdef SKETCH
typedef std::vector<unsigned char> Report;
static std::deque<Report> to_device, to_host;
static unsigned now_us = 0;
static int pins[64], encoder_count = 0;
static void (*tick)() = 0;
static unsigned tick_period_us = 0;

enum { LOW, HIGH, OUTPUT, INPUT_PULLUP };
static inline void pinMode(int, int) {}
static inline void analogWriteResolution(int) {}
static inline void analogWriteFrequency(int, float) {}
static inline void analogWrite(int pin, int value) { pins[pin] = value; }
static inline void digitalWrite(int pin, int value) { pins[pin] = value; }
static inline int digitalRead(int) { return HIGH; }
// As on a Teensy 3: micros() switches interrupts on again, whatever they were before.
static bool is_masked = false;
static int sections = 0, broken_sections = 0;
static inline void noInterrupts() { is_masked = true; }
static inline void interrupts() {
  sections++;
  if (!is_masked) broken_sections++;
  is_masked = false;
}
static inline unsigned micros() {
  is_masked = false;
  return now_us;
}

struct RawHidPort {
  int recv(void* buffer, int) {
    if (to_device.empty()) return 0;
    memcpy(buffer, to_device.front().data(), 64);
    to_device.pop_front();
    return 64;
  }
  int send(const void* buffer, int) {
    const unsigned char* bytes = (const unsigned char*)buffer;
    to_host.push_back(Report(bytes, bytes + 64));
    return 64;
  }
};
// each sketch uses one of them
__attribute__((unused)) static RawHidPort RawHID;

// A serial port at 1 Mbaud, one byte per 10 us each way, with an AVR's buffers of 63 bytes.
enum { A2 = 16 };
static int sensor = 500;
static inline int analogRead(int) { return sensor; }
static std::deque<unsigned char> line_in, received, sending, line_out;
static int overrun = 0;
struct SerialPort {
  void begin(unsigned long) {}
  int available() { return (int)received.size(); }
  int availableForWrite() { return 63 - (int)sending.size(); }
  int read() {
    const int byte = received.front();
    received.pop_front();
    return byte;
  }
  void write(unsigned char byte) {
    if (availableForWrite() <= 0) overrun++;  // it would wait
    sending.push_back(byte);
  }
};
__attribute__((unused)) static SerialPort Serial;
static inline void move_lines() {
  if (!line_in.empty()) {
    if (received.size() < 63) received.push_back(line_in.front());
    line_in.pop_front();
  }
  if (!sending.empty()) {
    line_out.push_back(sending.front());
    sending.pop_front();
  }
}

struct IntervalTimer {
  bool begin(void (*function)(), unsigned microseconds) {
    tick = function;
    tick_period_us = microseconds;
    return true;
  }
};

#include SKETCH

extern "C" {
void sketch_setup() { setup(); }
// Lets time pass; `loops` false: loop() hangs and only the timer's interrupt runs.
void sketch_run(unsigned microseconds, int loops) {
  for (unsigned end = now_us + microseconds; now_us != end; now_us += 10) {
    move_lines();
    if (loops) loop();
    if (tick && now_us % tick_period_us == 0) tick();
  }
}
void sketch_line(const unsigned char* bytes, unsigned count) {
  line_in.insert(line_in.end(), bytes, bytes + count);
}
int sketch_take(unsigned char* bytes, unsigned space) {
  unsigned count = 0;
  for (; count < space && !line_out.empty(); count++) {
    bytes[count] = line_out.front();
    line_out.pop_front();
  }
  return (int)count;
}
void sketch_sense(int reading) { sensor = reading; }
void sketch_send(const unsigned char* frame) { to_device.push_back(Report(frame, frame + 64)); }
int sketch_fetch(unsigned char* frame) {
  if (to_host.empty()) return 0;
  memcpy(frame, to_host.front().data(), 64);
  to_host.pop_front();
  return 1;
}
void sketch_turn(int count) { encoder_count = count; }
int sketch_pin(int pin) { return pins[pin]; }
int sketch_overrun() { return overrun; }
int sketch_sections() { return sections; }
int sketch_broken_sections() { return broken_sections; }
}
#else
#include "hb_protocol.h"

static HbSheet sheet = {HB_X | HB_RZ, 990, NAN, 0.4f, NAN,  0.01f, 0.05f,
                        1.5e-5f,      4,   0.1f, 2,   5e-4f, 0, 0, "shim", 0};
static const HbGrip grip = {0.05f, 2, NAN, 1e-5f, 8, 3, 0.03f};
static HbDevice* device = 0;

extern "C" {
unsigned shim_crc(const unsigned char* data, unsigned count) { return hb_crc16(data, count); }
void shim_reset() {
  delete device;
  device = new HbDevice(sheet);
}
void shim_reset_with_grip() {
  delete device;
  HbSheet with_grip = sheet;
  with_grip.axes |= HB_GRIP;
  with_grip.grip = &grip;
  device = new HbDevice(with_grip);
}
void shim_grip_state(float position, float speed, unsigned char* frame) {
  HbMotion motion;
  memset(&motion, 0, sizeof motion);
  motion.angular_velocity[2] = 7;
  motion.grip_position = position;
  motion.grip_speed = speed;
  device->state(motion, 0, frame);
}
float shim_grip_force(unsigned now_us) { return device->wrench(now_us).grip; }
int shim_receive(const unsigned char* frame, unsigned now_us) {
  return device->receive(frame, now_us);
}
unsigned shim_line(const unsigned char* bytes, unsigned count, unsigned now_us) {
  unsigned frames = 0;
  for (unsigned i = 0; i < count; i++) frames += device->receive_byte(bytes[i], now_us);
  return frames;
}
int shim_answer(unsigned char* frame) { return device->answer(frame); }
void shim_state(const float* numbers, unsigned buttons, unsigned status, unsigned now_us,
                unsigned char* frame) {
  HbMotion motion;
  memcpy(motion.position, numbers, 12);
  memcpy(motion.rotation, numbers + 3, 12);
  memcpy(motion.velocity, numbers + 6, 12);
  memcpy(motion.angular_velocity, numbers + 9, 12);
  motion.buttons = (uint16_t)buttons;
  motion.status = (uint8_t)status;
  device->state(motion, now_us, frame);
}
void shim_wrench(unsigned now_us, float* wrench) {
  HbWrench w = device->wrench(now_us);
  memcpy(wrench, w.force, 12);
  memcpy(wrench + 3, w.torque, 12);
}
}
#endif
