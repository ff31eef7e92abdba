// The raw HID protocol of hapticbridge, version 1, on the device's side. Plain C++11: no Arduino, no
// heap, no exceptions. ../../rawhid.md documents it; this file is all that a device needs.
//
//   HbDevice device(sheet);
//   device.receive(frame, now_us);              // any report from the host, 64 bytes
//   device.receive_byte(byte, now_us);          // or, on a serial line, every byte from it
//   if (device.answer(frame)) send(frame);      // the host has requested the data sheet
//   device.state(motion, now_us, frame);        // once per period: its motion
//   HbWrench wrench = device.wrench(now_us);    // wrench for the motors; call it often
//
// An HbDevice belongs to one thread. An interrupt that drives the motors works on a copy of
// device.command(), so that interrupts are disabled only while it is copied.
//
// Licence: Apache-2.0, as the rest of hapticbridge.
#ifndef HB_PROTOCOL_H
#define HB_PROTOCOL_H

#include <stddef.h>
#include <stdint.h>

#include "hb_constants.h"
#include "hb_loop.h"

static const size_t HB_NAME_BYTES = 54;

// Axes, one bit each: along x, y, z and about them; and the grip between the fingers. HB_POSE is set
// by an HbPoseBoard, whose loop renders rotation beside lines.
enum HbAxis {
  HB_X = 1,
  HB_Y = 2,
  HB_Z = 4,
  HB_RX = 8,
  HB_RY = 16,
  HB_RZ = 32,
  HB_GRIP = 64,
  HB_POSE = 128
};

// Status bits of a state frame. The builder sets SATURATED, FAULT and NOT_READY in HbMotion; the
// others are the protocol's.
enum HbStatus {
  HB_ENABLED = 1,     // the motors follow the newest force frame
  HB_WATCHDOG = 2,    // the watchdog has zeroed the wrench since then
  HB_SATURATED = 4,   // the motors could not apply the whole wrench
  HB_FAULT = 8,       // encoder, driver or temperature: the device gives no force
  HB_NOT_READY = 16,  // the pose is not valid yet
  HB_DAMAGED = 32,    // a frame with a wrong CRC has come since the newest valid one
  // in the place of HB_FAULT, where its cause is known
  HB_FAULT_TEMPERATURE = HB_FAULT | HB_CAUSE_TEMPERATURE,  // a motor or its driver is too hot
  HB_FAULT_ENCODER = HB_FAULT | HB_CAUSE_ENCODER,          // an encoder is not read
  HB_FAULT_DRIVER = HB_FAULT | HB_CAUSE_DRIVER             // a motor's driver has switched off
};

// Data sheet of a grip axis; NAN for unknown numbers. The limits must be known.
struct HbGrip {
  float mass;         // kg, at the fingers
  float damping;      // N s/m, physical
  float friction;     // N, Coulomb
  float resolution;   // m, step of the reported position
  float force_limit;  // N
  float speed_limit;  // m/s
  float travel;       // m, how far it closes
};

// Data sheet of the device; NAN for unknown numbers. rate, speed_limit, and the limit of each kind
// of axis that it has must be known.
struct HbSheet {
  uint16_t axes;             // HbAxis bits, at least one
  float rate;                // state frames per second
  float mass;                // kg, at the handle
  float damping;             // N s/m, physical, at the handle
  float rotational_inertia;  // kg m2
  float rotational_damping;  // N m s/rad
  float friction;            // N, Coulomb, per axis
  float resolution;          // m, step of the reported position
  float force_limit;         // N, by norm
  float torque_limit;        // N m, by norm
  float speed_limit;         // m/s
  float delay;               // s, latch of the pose to sending it, plus reception to motors
  float loop_rate;           // Hz, periods of an HbLoop per second; 0 without one
  float loop_delay;          // s, in that loop from reading a position to its force
  const char* name;          // UTF-8, at most HB_NAME_BYTES
  const HbGrip* grip;        // its grip axis; read only with HB_GRIP in axes
};

// Motion of the device in its own frame, latched at one time. Missing axes stay 0.
struct HbMotion {
  float position[3];          // m
  float rotation[3];          // rad, rotation vector: axis times angle
  float velocity[3];          // m/s
  float angular_velocity[3];  // rad/s
  uint16_t buttons;
  uint8_t status;  // HB_SATURATED, HB_FAULT, HB_NOT_READY
  // with a grip axis, sent in place of the angular velocity
  float grip_position;  // m, rises as it closes
  float grip_speed;     // m/s
};

// Wrench that the motors must apply.
struct HbWrench {
  float force[3];   // N, on the handle, in the device's frame
  float torque[3];  // N m
  float grip;       // N, closes the grip
};

// Command of the host with its expiry: all that an interrupt needs.
struct HbCommand {
  HbWrench commanded;
  uint32_t received_us;
  uint32_t watchdog_us;
  bool is_enabled;
  bool has_expired;
  bool is_unfit;  // HB_FAULT or HB_NOT_READY was set in the device's last state

  // Creates a command without a wrench.
  HbCommand();

  // Returns the present wrench: zero unless the newest force frame enabled the motors and is younger
  // than its watchdog. Call it often, best from a timer's interrupt, so that a main loop that hangs
  // cannot leave a force on the motors.
  HbWrench wrench(uint32_t now_us);
};

// What the host wants of a loop on the board.
struct HbOrder {
  enum Kind { NONE, SHOW, SET } kind;
  HbShown shown;
  bool is_placed;
  HbSetting setting;
};

// CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF, no reflection. "123456789" gives 0x29B1.
uint16_t hb_crc16(const uint8_t* data, size_t count);

class HbDevice {
 public:
  explicit HbDevice(const HbSheet& sheet);

  // Decodes one report from the host and returns whether it was a valid frame. A frame that is
  // damaged, of another version, or with a non-finite number changes no force.
  bool receive(const uint8_t frame[HB_FRAME_BYTES], uint32_t now_us);

  // Takes one byte of a serial line, on which frames follow each other without a gap. Returns true at
  // the end of a valid frame. If the 64 bytes from a magic byte on are not one, it searches the next
  // magic byte among them; so a lost, doubled or damaged byte costs only the frames it touched.
  bool receive_byte(uint8_t byte, uint32_t now_us);

  // Fills in the requested page of the sheet; returns false without a request.
  bool answer(uint8_t frame[HB_FRAME_BYTES]);

  // Fills in a state frame and counts it. While the motion's status has HB_FAULT or HB_NOT_READY,
  // wrench() returns zero.
  void state(const HbMotion& motion, uint32_t now_us, uint8_t frame[HB_FRAME_BYTES]);

  // Command of the host; it changes with receive() and with state().
  const HbCommand& command() const { return command_; }

  // Order for a loop in the frame that receive() has just taken; its kind is NONE for another frame.
  const HbOrder& order() const { return order_; }

  // True from the first order for a loop until the next force frame.
  bool is_loop() const { return is_loop_; }

  // True if it only turns, about one axis: numbers of a loop are then angles in rad and torques in N m.
  bool turns() const { return (sheet_.axes & (HB_X | HB_Y | HB_Z | HB_POSE)) == 0; }

  // As state(), of a loop: its force and account in place of the rotation.
  void loop_state(const HbMotion& motion, const HbReport& report, uint32_t now_us,
                  uint8_t frame[HB_FRAME_BYTES]);

  // Fills in the frame that follows a loop_state() of an HbPoseLoop: the rotation.
  void loop_turn(const HbMotion& motion, const HbReport& report, uint8_t frame[HB_FRAME_BYTES]);

  // Fills in the frame with the counters of a loop.
  void loop_report(const HbReport& report, const HbPace& pace, uint8_t frame[HB_FRAME_BYTES]);

  // Returns the present wrench, see HbCommand.
  HbWrench wrench(uint32_t now_us) { return command_.wrench(now_us); }

 private:
  HbSheet sheet_;
  bool take_order(const uint8_t frame[HB_FRAME_BYTES]);
  void begin_state(uint8_t kind, const HbMotion& motion, uint32_t now_us,
                   uint8_t frame[HB_FRAME_BYTES]);

  HbCommand command_;
  HbOrder order_;
  bool is_loop_;
  uint16_t planes_sequence_;
  uint16_t sequence_;
  uint16_t echo_;
  uint16_t asked_sequence_;
  int16_t asked_page_;
  bool is_damaged_;
  uint8_t fill_;                  // bytes in line_
  uint8_t line_[HB_FRAME_BYTES];  // of a serial line, from a magic byte on
};

#endif
