// The raw HID protocol of hapticbridge, version 1, on the device's side. Plain C++11: no Arduino, no
// heap, no exceptions. The document is ../../rawhid.md; this is all of it that a device needs.
//
//   HbDevice device(sheet);
//   device.receive(frame, now_us);              // whatever came from the host, 64 bytes
//   if (device.answer(frame)) send(frame);      // the host has asked what this device is
//   device.state(motion, now_us, frame);        // once per period: where it is
//   HbWrench wrench = device.wrench(now_us);    // what the motors are to give now, often
//
// An HbDevice belongs to one thread. What drives the motors in an interrupt works on a copy of
// device.command(), so that interrupts are off for as long as that copy takes and no longer.
//
// Licence: Apache-2.0, as the rest of hapticbridge.
#ifndef HB_PROTOCOL_H
#define HB_PROTOCOL_H

#include <stddef.h>
#include <stdint.h>

static const size_t HB_FRAME_BYTES = 64;
static const size_t HB_NAME_BYTES = 54;

// Longest watchdog in ms that a host may ask for.
static const uint16_t HB_LONGEST_WATCHDOG_MS = 1000;

// Axes, one bit each: along x, y, z and about them.
enum HbAxis { HB_X = 1, HB_Y = 2, HB_Z = 4, HB_RX = 8, HB_RY = 16, HB_RZ = 32 };

// Status bits of a state frame. The builder sets SATURATED, FAULT and NOT_READY in HbMotion; the
// others are the protocol's.
enum HbStatus {
  HB_ENABLED = 1,     // the motors follow the newest force frame
  HB_WATCHDOG = 2,    // the watchdog has zeroed the wrench since then
  HB_SATURATED = 4,   // the motors could not give all of it
  HB_FAULT = 8,       // encoder, driver or temperature: the device gives no force
  HB_NOT_READY = 16,  // it does not know its pose yet
  HB_DAMAGED = 32     // a frame with a wrong CRC has come since the newest good one
};

// What the device says of itself. NAN where it is not known; rate, speed_limit, and the limit of
// each kind of axis that it has, must be known.
struct HbSheet {
  uint16_t axes;             // HbAxis bits, at least one
  float rate;                // state frames per second
  float mass;                // kg, felt at the handle
  float damping;             // N s/m, physical, at the handle
  float rotational_inertia;  // kg m2
  float rotational_damping;  // N m s/rad
  float friction;            // N, Coulomb, per axis
  float resolution;          // m, step of the reported position
  float force_limit;         // N, by norm
  float torque_limit;        // N m, by norm
  float speed_limit;         // m/s
  float delay;               // s, latch of the pose to sending it, plus reception to motors
  const char* name;          // UTF-8, at most HB_NAME_BYTES
};

// Where the device is, in its own frame, latched at one time. Axes that it lacks stay 0.
struct HbMotion {
  float position[3];          // m
  float rotation[3];          // rad, rotation vector: axis times angle
  float velocity[3];          // m/s
  float angular_velocity[3];  // rad/s
  uint16_t buttons;
  uint8_t status;  // HB_SATURATED, HB_FAULT, HB_NOT_READY
};

// What the motors are to give.
struct HbWrench {
  float force[3];   // N, on the handle, in the device's frame
  float torque[3];  // N m
};

// What the host has commanded, and until when: all that an interrupt needs.
struct HbCommand {
  HbWrench commanded;
  uint32_t received_us;
  uint32_t watchdog_us;
  bool is_enabled;
  bool has_expired;
  bool is_unfit;  // the device's last state said HB_FAULT or HB_NOT_READY

  // Nothing is commanded.
  HbCommand();

  // Returns what the motors are to give now: nothing unless the newest force frame enabled them and
  // is younger than the watchdog that it named. Call it often, best from a timer's interrupt, so
  // that a main loop that hangs cannot leave a force on the motors.
  HbWrench wrench(uint32_t now_us);
};

// CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF, no reflection. "123456789" gives 0x29B1.
uint16_t hb_crc16(const uint8_t* data, size_t count);

class HbDevice {
 public:
  explicit HbDevice(const HbSheet& sheet);

  // Takes one report from the host. Returns whether it was a valid frame. A frame that is damaged,
  // of another version, or with a number that is not finite changes no force.
  bool receive(const uint8_t frame[HB_FRAME_BYTES], uint32_t now_us);

  // Fills in the page of the sheet that the host has asked for; false where it has not.
  bool answer(uint8_t frame[HB_FRAME_BYTES]);

  // Fills in a state frame and counts it. While the motion's status says HB_FAULT or HB_NOT_READY,
  // wrench() gives nothing.
  void state(const HbMotion& motion, uint32_t now_us, uint8_t frame[HB_FRAME_BYTES]);

  // What the host has commanded. It changes with receive() and with state().
  const HbCommand& command() const { return command_; }

  // Returns what the motors are to give now, see HbCommand.
  HbWrench wrench(uint32_t now_us) { return command_.wrench(now_us); }

 private:
  HbSheet sheet_;
  HbCommand command_;
  uint16_t sequence_;
  uint16_t echo_;
  uint16_t asked_sequence_;
  int16_t asked_page_;
  bool is_damaged_;
};

#endif
