// A one-axis haptic device for hapticbridge on a serial port: a Hapkit board (ATmega328 at 16 MHz,
// magnetoresistive sensor, one motor on a capstan drive), or any Arduino or ESP32 with your own
// three functions.
//
// Files: this sketch, hb_constants.h, hb_loop.h, hb_protocol.h and hb_protocol.cpp in one folder named hapticbridge_serial.
// Board: Arduino Uno (the Hapkit is one). Then, on the computer:
//
//   hapticbridge devices
//   hapticbridge run peg_in_hole --device serial --force-limit 1
//
// FILL IN the part between the two lines of === below for your device. Everything else is the
// protocol; do not change it. The numbers here are an example: MEASURE YOURS. This sketch has not
// been verified on hardware.
//
// Before the first run: paddle unloaded, hand on the power switch, DUTY_LIMIT at 0.2. Push the
// paddle: if it runs away instead of resisting, swap the motor's wires or the sign in motor_write().

#include <math.h>
#include <string.h>

#include "hb_protocol.h"

#ifdef __AVR__
#include <avr/wdt.h>
#endif

// ======================================================================== your device, part 1: facts

const int PIN_SENSOR = A2;
const int PIN_PWM = 5, PIN_DIRECTION = 8;

const float MOTOR_PULLEY = 0.005f;  // m, radius that the cable runs on
const float SECTOR = 0.075f;        // m, radius of the driven sector
const float HANDLE = 0.070f;        // m, from the paddle's axis to the grip

// The sensor turns with the motor and reads SENSOR_SPAN steps per period of its magnet, twice a
// turn; a reading that falls or rises by more than SENSOR_FLIP has passed the end of a period.
const int SENSOR_SPAN = 980, SENSOR_FLIP = 490;
const float PERIODS_PER_TURN = 2.0f;

const float TORQUE_CONSTANT = 0.0136f;  // N m/A, the motor's data sheet
const float RESISTANCE = 2.5f;          // ohm, winding, driver and wires together
const float SUPPLY = 12.0f;             // V, at the driver
const float DUTY_LIMIT = 0.2f;          // of full PWM, 0 to 1; raise it when it has proved safe

// metres of handle per radian of the motor, and per step of the sensor
const float TRAVEL = HANDLE * MOTOR_PULLEY / SECTOR;
const float STEP = TRAVEL * 6.2831853f / (PERIODS_PER_TURN * SENSOR_SPAN);

// A frame takes 0.64 ms at this rate, which an ATmega328 at 16 MHz makes exactly; checking and
// writing frames take it about 0.5 ms per period in all.
const unsigned long BAUD = 1000000;
const uint32_t STATE_PERIOD_US = 2000;
const uint32_t CONTROL_PERIOD_US = 500;

HbSheet my_sheet() {
  HbSheet sheet;
  sheet.axes = HB_X;
  sheet.rate = 1e6f / STATE_PERIOD_US;
  sheet.mass = NAN;     // kg at the handle: 'hapticbridge identify' measures it
  sheet.damping = NAN;  // N s/m at the handle, by the same command; the bound needs it
  sheet.rotational_inertia = NAN;
  sheet.rotational_damping = NAN;
  sheet.friction = NAN;  // N at the handle
  sheet.resolution = STEP;
  sheet.force_limit = DUTY_LIMIT * SUPPLY / RESISTANCE * TORQUE_CONSTANT / TRAVEL;
  sheet.torque_limit = NAN;  // it does not turn
  sheet.speed_limit = 2.0f;  // m/s, faster than a hand moves it
  sheet.delay = 1e-6f * CONTROL_PERIOD_US;
  sheet.loop_rate = sheet.loop_delay = 0.0f;  // no loop of its own
  sheet.name = "Hapkit";
  return sheet;
}

// ================================================================== your device, part 2: three hooks

bool is_saturated = false;

void motor_setup() {
  pinMode(PIN_DIRECTION, OUTPUT);
  pinMode(PIN_PWM, OUTPUT);
  analogWrite(PIN_PWM, 0);
}

// Applies a force at the handle by the motor, 2000 times a second. Timer 0 makes the PWM and the
// clock, so do not change its prescaler.
void motor_write(const HbWrench& wrench) {
  const float torque = wrench.force[0] * TRAVEL;
  float duty = torque / TORQUE_CONSTANT * RESISTANCE / SUPPLY;
  is_saturated = fabsf(duty) > DUTY_LIMIT;
  if (duty > DUTY_LIMIT) duty = DUTY_LIMIT;
  if (duty < -DUTY_LIMIT) duty = -DUTY_LIMIT;
  digitalWrite(PIN_DIRECTION, duty < 0.0f ? LOW : HIGH);
  analogWrite(PIN_PWM, (int)(fabsf(duty) * 255.0f + 0.5f));
}

// Reads the handle's motion, once per state frame. The pose at power-on is x = 0: hold the paddle
// upright. A period of the sensor is 14.7 mm of handle, 7 ms at 2 m/s, so none is missed.
void motion_read(HbMotion& motion) {
  static int before = -1;
  static long periods = 0, origin = 0;
  static float last = 0.0f;
  const int reading = analogRead(PIN_SENSOR);
  if (before < 0) origin = before = reading;
  if (reading - before > SENSOR_FLIP) periods--;
  if (before - reading > SENSOR_FLIP) periods++;
  before = reading;
  motion.position[0] = STEP * (float)(periods * SENSOR_SPAN + reading - origin);
  motion.velocity[0] = (motion.position[0] - last) / (1e-6f * STATE_PERIOD_US);
  last = motion.position[0];
  motion.status = is_saturated ? HB_SATURATED : 0;
}

// Restarts a processor that hangs, and with it switches its pins off. On another processor than an
// AVR, use the one it has: without it a loop() that hangs leaves the last force on the motor.
void restart_if_hung(bool is_first) {
#ifdef __AVR__
  if (is_first) wdt_enable(WDTO_15MS);
  wdt_reset();
#else
#warning "fill in restart_if_hung() for this processor"
  (void)is_first;
#endif
}

// ========================================================================= protocol: do not change

HbDevice device(my_sheet());

// Bytes on their way to the host. Only as many as fit are handed to Serial, which would otherwise
// wait: a loop that waits loses received bytes and holds the force.
uint8_t outgoing[HB_FRAME_BYTES];
uint8_t sent = HB_FRAME_BYTES;

void send_rest() {
  while (sent < HB_FRAME_BYTES && Serial.availableForWrite() > 0) Serial.write(outgoing[sent++]);
}

void control(uint32_t now_us) {
  static uint32_t last_us = 0;
  if (now_us - last_us < CONTROL_PERIOD_US) return;
  last_us = now_us;
  motor_write(device.wrench(now_us));
}

// Sends one state frame per period, unless the frame before has not left.
void send_state(uint32_t now_us) {
  static uint32_t last_us = 0;
  if (now_us - last_us < STATE_PERIOD_US || sent < HB_FRAME_BYTES) return;
  last_us += STATE_PERIOD_US;
  if (now_us - last_us >= STATE_PERIOD_US) last_us = now_us;  // late: do not catch up in a burst
  HbMotion motion;
  memset(&motion, 0, sizeof motion);
  motion_read(motion);
  device.state(motion, now_us, outgoing);
  sent = 0;
}

void setup() {
  motor_setup();
  Serial.begin(BAUD);
  restart_if_hung(true);
}

void loop() {
  restart_if_hung(false);
  while (Serial.available() > 0) device.receive_byte((uint8_t)Serial.read(), micros());
  send_rest();
  if (sent == HB_FRAME_BYTES && device.answer(outgoing)) sent = 0;
  control(micros());
  send_state(micros());
}
