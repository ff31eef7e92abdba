// A one-axis haptic device for hapticbridge on a Teensy 3.5, 3.6, 4.0 or 4.1: a paddle on a capstan
// drive (as on the Hapkit), a quadrature encoder on the motor, and a driver with a PWM and a
// direction pin. It runs a loop of its own at 10 kHz for a host that shows its tool, and follows
// forces of a host that sends them.
//
// Tools > USB Type > Raw HID. Files: this sketch, the six of the name hb_*.h and hb_protocol.cpp
// in one folder named hapticbridge_rawhid. Needs only Teensyduino (its Encoder library and
// IntervalTimer). Then, on the computer: hapticbridge devices
//
// FILL IN the device. The numbers here are an example: MEASURE YOURS. This sketch has not been
// verified on hardware. hapticbridge guide stiff-device goes through it.
//
// Before the first run: paddle unloaded, hand on the power switch, duty limit at 0.2. Without
// a host there is no force. The first run pushes gently and stops if the motor goes the wrong way:
// then swap its wires, or the sign in write_force().

#include <Encoder.h>
#include <math.h>
#include <string.h>

#include "hb_sketch.h"

// ================================================================================ facts: fill in

const int PIN_ENCODER_A = 2, PIN_ENCODER_B = 3, PIN_PWM = 5, PIN_DIRECTION = 8;
const int PIN_BUTTON = 12;  // to ground; 255 if there is none

const float COUNTS_PER_TURN = 4.0f * 500.0f;  // of the motor's encoder, all four edges
const float MOTOR_PULLEY = 0.005f;            // m, radius that the cable runs on
const float SECTOR = 0.075f;                  // m, radius of the driven sector
const float HANDLE = 0.070f;                  // m, from the paddle's axis to the grip
const float TRAVEL = HANDLE * MOTOR_PULLEY / SECTOR;         // m of handle per rad of the motor
const float STEP = TRAVEL * 6.2831853f / COUNTS_PER_TURN;  // m of handle per count

// N m/A, ohm, H, V, and the share of full PWM: raise it when it has proved safe
HbMotor motor = {0.0136f, 2.5f, 0.2e-3f, 12.0f, 0.2f, TRAVEL, false};

const uint32_t LOOP_PERIOD_US = 100;
// On full speed the host fetches one report a millisecond. A device that is faster, even by 50 ppm,
// fills the queue of the USB driver, and from then on every pose is 4 ms old: so 1 % slower.
const uint32_t STATE_PERIOD_US = 1010;

HbSheet my_sheet() {
  HbSheet sheet = hb_unknown_sheet();
  sheet.name = "one-axis capstan paddle";
  sheet.axes = HB_X;
  sheet.rate = 1e6f / STATE_PERIOD_US;
  sheet.mass = NAN;      // kg at the handle: 'hapticbridge identify' measures these three
  sheet.damping = NAN;   // N s/m at the handle; the bound needs it
  sheet.friction = NAN;  // N at the handle
  sheet.resolution = STEP;
  sheet.force_limit = motor.force_limit();
  sheet.speed_limit = 2.0f;  // m/s, faster than a hand moves it
  sheet.delay = 1e-6f * LOOP_PERIOD_US;
  sheet.loop_delay = 40e-6f + motor.lag();  // s: computing and a period of the PWM, and the motor
  return sheet;
}

// ===================================================================== reads and writes: fill in

Encoder encoder(PIN_ENCODER_A, PIN_ENCODER_B);

// The pose at power-on is x = 0: hold the paddle upright.
void read_position(float position[3]) { position[0] = STEP * (float)encoder.read(); }

void write_force(const float force[3]) {
  const float duty = motor.duty(force[0]);
  digitalWrite(PIN_DIRECTION, duty < 0.0f ? LOW : HIGH);
  analogWrite(PIN_PWM, (int)(fabsf(duty) * 1023.0f + 0.5f));
}

// ========================================================================================== USB

HbSketch device(my_sheet(), LOOP_PERIOD_US);

void control_tick() { device.tick(); }

void setup() {
  pinMode(PIN_DIRECTION, OUTPUT);
  pinMode(PIN_PWM, OUTPUT);
  analogWriteResolution(10);
  analogWriteFrequency(PIN_PWM, 36000.0f);  // Hz, inaudible, within the driver's range
  analogWrite(PIN_PWM, 0);
  if (PIN_BUTTON != 255) pinMode(PIN_BUTTON, INPUT_PULLUP);
  device.start(control_tick);
}

void loop() {
  uint8_t frame[HB_FRAME_BYTES];
  device.poll();
  while (RawHID.recv(frame, 0) > 0) {
    device.receive(frame);
    if (device.answer(frame)) RawHID.send(frame, 100);
  }
  const uint16_t buttons = PIN_BUTTON != 255 && digitalRead(PIN_BUTTON) == LOW ? 1 : 0;
  // with HB_FAULT if your driver has a fault pin, with HB_NOT_READY while a device must be homed
  if (device.state(buttons, motor.status(), frame)) RawHID.send(frame, 0);
  if (device.more(frame)) RawHID.send(frame, 0);  // of a loop that renders rotation
}
