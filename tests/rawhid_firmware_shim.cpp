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
static void pinMode(int, int) {}
static void analogWriteResolution(int) {}
static void analogWriteFrequency(int, float) {}
static void analogWrite(int pin, int value) { pins[pin] = value; }
static void digitalWrite(int pin, int value) { pins[pin] = value; }
static int digitalRead(int) { return HIGH; }
// As on a Teensy 3: micros() switches interrupts on again, whatever they were before.
static bool is_masked = false;
static int sections = 0, broken_sections = 0;
static void noInterrupts() { is_masked = true; }
static void interrupts() {
  sections++;
  if (!is_masked) broken_sections++;
  is_masked = false;
}
static unsigned micros() {
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
static RawHidPort RawHID;

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
    if (loops) loop();
    if (now_us % tick_period_us == 0) tick();
  }
}
void sketch_send(const unsigned char* frame) { to_device.push_back(Report(frame, frame + 64)); }
int sketch_fetch(unsigned char* frame) {
  if (to_host.empty()) return 0;
  memcpy(frame, to_host.front().data(), 64);
  to_host.pop_front();
  return 1;
}
void sketch_turn(int count) { encoder_count = count; }
int sketch_pin(int pin) { return pins[pin]; }
int sketch_sections() { return sections; }
int sketch_broken_sections() { return broken_sections; }
}
#else
#include "hb_protocol.h"

static HbSheet sheet = {HB_X | HB_RZ, 990, NAN, 0.4f, NAN,  0.01f, 0.05f,
                        1.5e-5f,      4,   0.1f, 2,   5e-4f, "shim"};
static HbDevice* device = 0;

extern "C" {
unsigned shim_crc(const unsigned char* data, unsigned count) { return hb_crc16(data, count); }
void shim_reset() {
  delete device;
  device = new HbDevice(sheet);
}
int shim_receive(const unsigned char* frame, unsigned now_us) {
  return device->receive(frame, now_us);
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
