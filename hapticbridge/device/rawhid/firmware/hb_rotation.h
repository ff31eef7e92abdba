// Rotations in single precision, with the same bits on every processor: only sums, products,
// quotients and roots.
//
// A quaternion is (w, x, y, z) and of length 1; a rotation vector is its axis times its angle in
// rad. The turn between two quaternions is found from their difference, so a small turn is as
// precise as a large one, 3e-7 of it: energies of millions of turns add up to what they are.
//
// Licence: Apache-2.0, as the rest of hapticbridge.
#ifndef HB_ROTATION_H
#define HB_ROTATION_H

#include <math.h>
#include <stdint.h>
#include <string.h>

// Half a turn in rad.
static const float HB_HALF_TURN = 3.14159265f;

// Returns an angle in rad, 0 to a quarter turn, from multiples of its sine and cosine.
inline float hb_angle(float sine, float cosine) {
  // tan(a/2) = sin a / (1 + cos a), three times, and the series of the arc tangent to 1e-8
  float t = sine / (cosine + sqrtf(sine * sine + cosine * cosine));
  t = t / (1.0f + sqrtf(1.0f + t * t));
  t = t / (1.0f + sqrtf(1.0f + t * t));
  const float s = t * t;
  return 8.0f * t *
         (1.0f - s * (1.0f / 3.0f - s * (0.2f - s * (1.0f / 7.0f - s * (1.0f / 9.0f)))));
}

// Finds the rotation vector that leads from one quaternion to another, of at most half a turn.
inline void hb_turn(const float from[4], const float to[4], float turn[3]) {
  float cosine = from[0] * to[0] + from[1] * to[1] + from[2] * to[2] + from[3] * to[3];
  const float sign = cosine < 0.0f ? -1.0f : 1.0f;  // q and -q are one rotation
  cosine *= sign;
  float d[4];
  for (int i = 0; i < 4; i++) d[i] = sign * to[i] - from[i];
  turn[0] = from[0] * d[1] - d[0] * from[1] + (from[2] * d[3] - from[3] * d[2]);
  turn[1] = from[0] * d[2] - d[0] * from[2] + (from[3] * d[1] - from[1] * d[3]);
  turn[2] = from[0] * d[3] - d[0] * from[3] + (from[1] * d[2] - from[2] * d[1]);
  const float sine = sqrtf(turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2]);
  const float factor = sine > 0.0f ? 2.0f * hb_angle(sine, cosine) / sine : 2.0f / cosine;
  for (int i = 0; i < 3; i++) turn[i] *= factor;
}

// Makes a quaternion one of length 1.
inline void hb_normalize(float q[4]) {
  const float factor = 1.0f / sqrtf(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  for (int i = 0; i < 4; i++) q[i] *= factor;
}

// Turns a rotation by a rotation vector, a longer one by half a turn.
inline void hb_turned(const float turn[3], const float from[4], float to[4]) {
  float square = turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2];
  float length = 0.125f;
  if (square > HB_HALF_TURN * HB_HALF_TURN) {
    length *= HB_HALF_TURN / sqrtf(square);
    square = HB_HALF_TURN * HB_HALF_TURN;
  }
  // series of sin x / x and cos x at an eighth of the angle, doubled twice
  const float s = 0.015625f * square;
  float sine = 1.0f - s * (1.0f / 6.0f) * (1.0f - s * 0.05f * (1.0f - s * (1.0f / 42.0f)));
  float cosine = 1.0f - s * (1.0f / 30.0f) * (1.0f - s * (1.0f / 56.0f));
  cosine = 1.0f - s * 0.5f * (1.0f - s * (1.0f / 12.0f) * cosine);
  for (int k = 0; k < 2; k++) {
    const float doubled = 2.0f * sine * cosine;
    cosine = 1.0f - 2.0f * s * sine * sine;
    sine = doubled;
  }
  const float x = sine * length * turn[0], y = sine * length * turn[1], z = sine * length * turn[2];
  const float q[4] = {cosine * from[0] - x * from[1] - y * from[2] - z * from[3],
                      cosine * from[1] + x * from[0] + y * from[3] - z * from[2],
                      cosine * from[2] - x * from[3] + y * from[0] + z * from[1],
                      cosine * from[3] + x * from[2] - y * from[1] + z * from[0]};
  memcpy(to, q, sizeof q);
  hb_normalize(to);
}

// True for a quaternion of a length near 1. It tests the bits, so that it holds under -ffast-math too.
inline bool hb_is_rotation(const float q[4]) {
  uint32_t bits[4];
  memcpy(bits, q, sizeof bits);
  for (int i = 0; i < 4; i++) {
    if ((bits[i] & 0x7F800000u) >= 0x40000000u) return false;  // 2 or more, or no number
  }
  const float square = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
  return square > 0.5f && square < 2.0f;
}

#endif
