// A one-axis haptic device for hapticbridge on a Teensy 3.5, 3.6, 4.0 or 4.1: a paddle on a capstan
// drive (as on the Hapkit), a quadrature encoder on the motor, and a driver with a PWM and a
// direction pin. It follows the host's forces, or runs a loop of its own at 10 kHz for a host that
// shows its tool. A board without a floating-point unit is too slow for that loop: give it an
// HbDevice in the place of the HbBoard, as hapticbridge_serial.ino has it.
//
// Tools > USB Type > Raw HID. Files: this sketch and the four of the name hb_*.h and hb_protocol.cpp
// in one folder.
// Needs only Teensyduino (its Encoder library and IntervalTimer). Then, on the computer:
//
//   hapticbridge devices
//   hapticbridge run peg_in_hole --device rawhid --force-limit 1
//
// FILL IN the part between the two lines of === below for your device: pins, dimensions, the motor,
// and three functions. Everything else is the protocol; do not change it. The numbers here are an
// example: MEASURE YOURS. This sketch has not been verified on hardware.
//
// Before the first run: paddle unloaded, hand on the power switch, DUTY_LIMIT at 0.2. Push the
// paddle: if it runs away instead of resisting, swap the motor's wires or the sign in motor_write().

#include <Encoder.h>
#include <math.h>
#include <string.h>

#include "hb_board.h"

// ======================================================================== your device, part 1: facts

const int PIN_ENCODER_A = 2, PIN_ENCODER_B = 3;
const int PIN_PWM = 5, PIN_DIRECTION = 8;
const int PIN_BUTTON = 12;  // to ground; 255 if there is none

const float COUNTS_PER_TURN = 4.0f * 500.0f;  // of the motor's encoder, all four edges
const float MOTOR_PULLEY = 0.005f;            // m, radius that the cable runs on
const float SECTOR = 0.075f;                  // m, radius of the driven sector
const float HANDLE = 0.070f;                  // m, from the paddle's axis to the grip

const float TORQUE_CONSTANT = 0.0136f;  // N m/A, the motor's data sheet
const float RESISTANCE = 2.5f;          // ohm, winding, driver and wires together
const float SUPPLY = 12.0f;             // V, at the driver
const float DUTY_LIMIT = 0.2f;          // of full PWM, 0 to 1; raise it when it has proved safe
const float PWM_FREQUENCY = 36000.0f;   // Hz, inaudible, within the driver's range

// metres of handle per radian of the motor, and per count of the encoder
const float TRAVEL = HANDLE * MOTOR_PULLEY / SECTOR;
const float STEP = TRAVEL * 6.2831853f / COUNTS_PER_TURN;

const uint32_t STATE_PERIOD_US = 1010;  // see send_state() before you make it shorter
const uint32_t CONTROL_PERIOD_US = 100;       // of the loop on the board; it takes about 10

HbSheet my_sheet() {
  HbSheet sheet;
  sheet.axes = HB_X;
  sheet.rate = 1e6f / STATE_PERIOD_US;
  sheet.mass = NAN;     // kg at the handle: swing it, or leave it unknown
  sheet.damping = NAN;  // N s/m at the handle: coast-down with the motor off; the bound needs it
  sheet.rotational_inertia = NAN;
  sheet.rotational_damping = NAN;
  sheet.friction = NAN;  // N at the handle: the force that just moves it, with a spring balance
  sheet.resolution = STEP;
  sheet.force_limit = DUTY_LIMIT * SUPPLY / RESISTANCE * TORQUE_CONSTANT / TRAVEL;
  sheet.torque_limit = NAN;  // it does not turn
  sheet.speed_limit = 2.0f;  // m/s, faster than a hand moves it
  sheet.delay = 1e-6f * CONTROL_PERIOD_US;
  sheet.loop_delay = 10e-6f;  // s, from read_position() to write_force()
  sheet.name = "one-axis capstan paddle";
  return sheet;
}

// ================================================================== your device, part 2: three hooks

Encoder encoder(PIN_ENCODER_A, PIN_ENCODER_B);
volatile bool is_saturated = false;

void motor_setup() {
  pinMode(PIN_DIRECTION, OUTPUT);
  pinMode(PIN_PWM, OUTPUT);
  analogWriteResolution(10);
  analogWriteFrequency(PIN_PWM, PWM_FREQUENCY);
  analogWrite(PIN_PWM, 0);
  if (PIN_BUTTON != 255) pinMode(PIN_BUTTON, INPUT_PULLUP);
  encoder.write(0);  // the pose at power-on is x = 0: hold the paddle upright
}

// Reads the handle's position in m. Called from the interrupt, once per period of the loop.
void read_position(float position[3]) { position[0] = STEP * (float)encoder.read(); }

// Applies a force in N at the handle by the motor. Called from the interrupt, with zero where there
// is to be none: it must not wait, print or allocate.
void write_force(const float force[3]) {
  const float torque = force[0] * TRAVEL;
  float duty = torque / TORQUE_CONSTANT * RESISTANCE / SUPPLY;
  is_saturated = fabsf(duty) > DUTY_LIMIT;
  if (duty > DUTY_LIMIT) duty = DUTY_LIMIT;
  if (duty < -DUTY_LIMIT) duty = -DUTY_LIMIT;
  digitalWrite(PIN_DIRECTION, duty < 0.0f ? LOW : HIGH);
  analogWrite(PIN_PWM, (int)(fabsf(duty) * 1023.0f + 0.5f));
}

// Reads the handle's motion. Called from loop(), once per state frame.
void motion_read(HbMotion& motion) {
  static float last = 0.0f;
  read_position(motion.position);
  motion.velocity[0] = (motion.position[0] - last) / (1e-6f * STATE_PERIOD_US);
  last = motion.position[0];
  motion.buttons = PIN_BUTTON != 255 && digitalRead(PIN_BUTTON) == LOW ? 1 : 0;
  // set HB_FAULT here if your driver has a fault pin, HB_NOT_READY while your device must be homed
  motion.status = is_saturated ? HB_SATURATED : 0;
}

// ========================================================================= protocol: do not change

HbBoard board(my_sheet(), 1e-6f * CONTROL_PERIOD_US);
IntervalTimer control;

// Runs in an interrupt, so that a loop() that hangs cannot leave a force on the motor: no frame is
// received then, and the patience of the last one ends here. A processor that has stopped keeps its
// PWM: if your driver has an enable input, drive it by a hardware watchdog.
void control_tick() {
  float position[3] = {0.0f, 0.0f, 0.0f}, force[3];
  read_position(position);
  board.tick(position, micros(), force);
  write_force(force);
}

void setup() {
  motor_setup();
  control.begin(control_tick, CONTROL_PERIOD_US);
}

// Sends one state frame per period. On full speed the host fetches one report a millisecond; a
// device that is faster, even by 50 ppm, fills the queue of four in the USB driver, and
// from then on every pose is 4 ms old. So the period is 1 % longer than the host's.
void send_state(uint32_t now_us) {
  static uint32_t last_us = 0;
  if (now_us - last_us < STATE_PERIOD_US) return;
  last_us += STATE_PERIOD_US;
  if (now_us - last_us >= STATE_PERIOD_US) last_us = now_us;  // late: do not catch up in a burst
  HbMotion motion;
  memset(&motion, 0, sizeof motion);
  motion_read(motion);
  uint8_t frame[HB_FRAME_BYTES];
  board.state(motion, now_us, frame);
  RawHID.send(frame, 0);
}

void loop() {
  uint8_t frame[HB_FRAME_BYTES];
  while (RawHID.recv(frame, 0) > 0) {
    board.receive(frame, micros());
    if (board.answer(frame)) RawHID.send(frame, 100);
  }
  send_state(micros());
}
