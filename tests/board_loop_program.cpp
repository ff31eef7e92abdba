// The loop on the board in a fixed motion, natively or on an emulated Cortex-M: it prints the bits of
// what it computed, and on a Cortex-M the instructions of a period.
#include "hb_loop.h"

namespace {

uint32_t seed = 1;

// Returns a number from -1 to 1.
float draw() {
  seed = seed * 1664525u + 1013904223u;
  return (float)(int32_t)seed * 4.656613e-10f;
}

uint32_t mixed(uint32_t sum, float value) {
  uint32_t bits;
  memcpy(&bits, &value, 4);
  return (sum ^ bits) * 16777619u;
}

void say(const char* text);
void finish();
uint32_t clock_now();
float instructions_per_count();

void say_number(const char* loop, const char* name, uint32_t value) {
  char text[11];
  for (int k = 9; k >= 0; k--, value /= 10u) text[k] = (char)('0' + value % 10u);
  text[10] = 0;
  say(loop);
  say(name);
  say(text);
  say("\n");
}

template <bool TURNS>
void run(const char* name) {
  HbLoopOf<TURNS> loop(1e-4f);
  HbSetting setting;
  memset(&setting, 0, sizeof setting);
  setting.gains.stiffness = 20000.0f;
  setting.gains.damping = 0.5f;
  setting.gains.level = 5.0f;
  setting.turn_gains.stiffness = 10.0f;
  setting.turn_gains.damping = 1e-4f;
  setting.turn_gains.level = 0.1f;
  setting.credit = 10000000000LL;
  setting.fade = 0.01f;
  setting.patience = 0.05f;
  setting.is_enabled = true;
  loop.set(setting);
  float hand[3] = {0.0f, 0.0f, 0.0f}, velocity[3] = {0.0f, 0.0f, 0.0f}, force[3];
  float rotation[4] = {1.0f, 0.0f, 0.0f, 0.0f}, turning[3] = {0.0f, 0.0f, 0.0f};
  float torque[3] = {0.0f, 0.0f, 0.0f};
  uint32_t sum = 2166136261u, largest = 0, total = 0;
  HbEnergy work = 0;
  for (int tick = 0; tick < 5000; tick++) {
    for (int i = 0; i < 3; i++) {
      velocity[i] += 0.005f * draw() - 0.01f * velocity[i];
      hand[i] += 1e-4f * velocity[i];
    }
    if (TURNS) {
      float turn[3];
      for (int i = 0; i < 3; i++) {
        turning[i] += 0.1f * draw() - 0.01f * turning[i];
        turn[i] = 1e-4f * turning[i];
      }
      hb_turned(turn, rotation, rotation);
    }
    if (tick % 20 == 0) {
      HbShown shown;
      memset(&shown, 0, sizeof shown);
      shown.has_velocity = tick % 40 == 0;
      shown.planes = (uint8_t)(tick / 20 % (HB_PLANES + 1));
      for (int i = 0; i < 3; i++) {
        shown.position[i] = hand[i] + 2e-4f * draw();
        shown.velocity[i] = velocity[i] + 0.02f * draw();
        if (i < shown.planes) {
          shown.plane[i].normal[i] = draw() < 0.0f ? -1.0f : 1.0f;
          shown.plane[i].gap = 1e-5f + 1e-5f * draw();
        }
      }
      if (TURNS) {
        float turn[3];
        for (int i = 0; i < 3; i++) {
          turn[i] = (tick % 100 == 0 ? 3.0f : 5e-3f) * draw();
          shown.turning[i] = turning[i] + 0.5f * draw();
        }
        hb_turned(turn, rotation, shown.rotation);
      }
      work += 1000000;
      shown.work = work;
      loop.show(shown, false);
    }
    const uint32_t before = clock_now();
    loop.tick(hand, rotation, force, torque);
    const uint32_t taken = clock_now() - before;
    total += taken;
    if (taken > largest) largest = taken;
    for (int i = 0; i < 3; i++) sum = mixed(mixed(sum, force[i]), torque[i]);
    sum = mixed(sum, (float)loop.report().tank);
  }
  say_number(name, "bits ", sum);
  say_number(name, "held back ", loop.report().held_back);
  const float each = instructions_per_count();
  if (each > 0.0f) {
    say_number(name, "instructions, mean ", (uint32_t)((float)total / 5000.0f * each));
    say_number(name, "instructions, most ", (uint32_t)((float)largest * each));
  }
}

void run_both() {
  run<false>("lines: ");
  run<true>("poses: ");
}

#ifdef __arm__

// Emulated with one instruction per ns; the system timer of each board counts at a rate of its own.
volatile uint32_t* const SYSTEM_TIMER = (volatile uint32_t*)0xE000E010;
volatile uint32_t* const COPROCESSORS = (volatile uint32_t*)0xE000ED88;

void semihosted(int number, const void* argument) {
  register int r0 __asm__("r0") = number;
  register const void* r1 __asm__("r1") = argument;
  __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
}

void say(const char* text) { semihosted(4, text); }

void finish() {
  const uint32_t reason[2] = {0x20026, 0};
  semihosted(0x20, reason);
}

uint32_t clock_now() { return 0xFFFFFFu - SYSTEM_TIMER[2]; }

float instructions_per_count() {
  const uint32_t before = clock_now();
  uint32_t left = 50000u;
  __asm__ volatile("1: subs %0, #1\n bne 1b" : "+r"(left) : : "cc");
  return 100000.0f / (float)(clock_now() - before);
}

#else

#include <stdio.h>

void say(const char* text) { fputs(text, stdout); }

void finish() {}

uint32_t clock_now() { return 0; }

float instructions_per_count() { return 0.0f; }

#endif

}  // namespace

#ifdef __arm__

extern "C" {
void start() {
  *COPROCESSORS |= 0xFu << 20;  // the floating-point unit
  __asm__ volatile("dsb\n isb");
  SYSTEM_TIMER[1] = 0xFFFFFFu;
  SYSTEM_TIMER[0] = 5u;
  run_both();
  finish();
  for (;;) {
  }
}

extern char stack_end;
__attribute__((section(".vectors"), used)) const void* const VECTORS[2] = {&stack_end,
                                                                          (const void*)start};
}

#else

int main() {
  run_both();
  finish();
}

#endif
