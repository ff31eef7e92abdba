// A one-axis haptic device for hapticbridge on a serial port: a paddle on a capstan drive with a
// magnetoresistive sensor and one motor. A 32-bit board with a floating-point unit (Teensy, RP2350,
// STM32, ESP32) runs a loop of its own at 10 kHz for a host that shows its tool, and follows forces
// of a host that sends them. A Hapkit (ATmega328 at 16 MHz) is too slow for the loop: it follows
// forces alone.
//
// Files: this sketch, the six of the name hb_*.h and hb_protocol.cpp in one folder named
// hapticbridge_serial. The Hapkit's board is an Arduino Uno. Then, on the computer:
// hapticbridge devices
//
// FILL IN the device. The numbers here are an example: MEASURE YOURS. This sketch has not been
// verified on hardware. hapticbridge guide stiff-device goes through it.
//
// Before the first run: paddle unloaded, hand on the power switch, duty limit at 0.2. Without
// a host there is no force. The first run pushes gently and stops if the motor goes the wrong way:
// then swap its wires, or the sign in write_force().

#include <math.h>
#include <string.h>

#include "hb_sketch.h"

// ================================================================================ facts: fill in

const int PIN_SENSOR = A2, PIN_PWM = 5, PIN_DIRECTION = 8;

// The sensor turns with the motor and reads SENSOR_SPAN steps per period of its magnet, twice a
// turn; a reading that falls or rises by more than SENSOR_FLIP has passed the end of a period.
const int SENSOR_SPAN = 980, SENSOR_FLIP = 490;
const float PERIODS_PER_TURN = 2.0f;
const float MOTOR_PULLEY = 0.005f;  // m, radius that the cable runs on
const float SECTOR = 0.075f;        // m, radius of the driven sector
const float HANDLE = 0.070f;        // m, from the paddle's axis to the grip
const float TRAVEL = HANDLE * MOTOR_PULLEY / SECTOR;  // m of handle per rad of the motor
const float STEP = TRAVEL * 6.2831853f / (PERIODS_PER_TURN * SENSOR_SPAN);  // m of handle

// N m/A, ohm, H, V, and the share of full PWM: raise it when it has proved safe
HbMotor motor = {0.0136f, 2.5f, 0.2e-3f, 12.0f, 0.2f, TRAVEL, false};

// A frame takes 0.64 ms at this rate, which an ATmega328 at 16 MHz makes exactly; checking and
// writing frames take that one about 0.5 ms per state.
const unsigned long BAUD = 1000000;
const uint32_t STATE_PERIOD_US = HB_HAS_LOOP ? 1000 : 2000;
const uint32_t LOOP_PERIOD_US = HB_HAS_LOOP ? 100 : 500;

HbSheet my_sheet() {
  HbSheet sheet = hb_unknown_sheet();
  sheet.name = "Hapkit";
  sheet.axes = HB_X;
  sheet.rate = 1e6f / STATE_PERIOD_US;
  sheet.mass = NAN;      // kg at the handle: 'hapticbridge identify' measures these three
  sheet.damping = NAN;   // N s/m at the handle; the bound needs it
  sheet.friction = NAN;  // N at the handle
  sheet.resolution = STEP;
  sheet.force_limit = motor.force_limit();
  sheet.speed_limit = 2.0f;  // m/s, faster than a hand moves it
  sheet.delay = 1e-6f * LOOP_PERIOD_US;
  // s, from read_position() to the motor's force: converting, a period of the PWM, and the motor
  sheet.loop_delay = HB_HAS_LOOP ? 60e-6f + motor.lag() : 0.0f;
  return sheet;
}

// ===================================================================== reads and writes: fill in

// The pose at power-on is x = 0: hold the paddle upright. A period of the sensor is 14.7 mm of
// handle, 7 ms at 2 m/s, so none is missed.
void read_position(float position[3]) {
  static int before = -1;
  static long periods = 0, origin = 0;
  const int reading = analogRead(PIN_SENSOR);
  if (before < 0) origin = before = reading;
  if (reading - before > SENSOR_FLIP) periods--;
  if (before - reading > SENSOR_FLIP) periods++;
  before = reading;
  position[0] = STEP * (float)(periods * SENSOR_SPAN + reading - origin);
}

// On an ATmega328, timer 0 makes the PWM and the clock, so do not change its prescaler.
void write_force(const float force[3]) {
  const float duty = motor.duty(force[0]);
  digitalWrite(PIN_DIRECTION, duty < 0.0f ? LOW : HIGH);
  analogWrite(PIN_PWM, (int)(fabsf(duty) * 255.0f + 0.5f));
}

// ======================================================================================= serial

HbSketch device(my_sheet(), LOOP_PERIOD_US);

// Bytes on their way to the host. Only as many as fit are handed to Serial, which would otherwise
// wait: a loop that waits loses received bytes and holds the force.
uint8_t outgoing[HB_FRAME_BYTES], sent = HB_FRAME_BYTES;

void control_tick() { device.tick(); }

void setup() {
  pinMode(PIN_DIRECTION, OUTPUT);
  pinMode(PIN_PWM, OUTPUT);
#ifdef TEENSYDUINO  // another board's PWM should be as fast: its period is part of loop_delay
  analogWriteFrequency(PIN_PWM, 36000.0f);
#endif
  analogWrite(PIN_PWM, 0);
  Serial.begin(BAUD);
  device.start(control_tick);
}

void loop() {
  device.poll();
  while (Serial.available() > 0) device.receive_byte((uint8_t)Serial.read());
  while (sent < HB_FRAME_BYTES && Serial.availableForWrite() > 0) Serial.write(outgoing[sent++]);
  if (sent < HB_FRAME_BYTES) return;
  if (device.more(outgoing) || device.answer(outgoing) ||
      device.state(0, motor.status(), outgoing)) {
    sent = 0;
  }
}
