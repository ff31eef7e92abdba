// Written by scripts/make_firmware_constants.py; do not edit.
#ifndef HB_CONSTANTS_H
#define HB_CONSTANTS_H

static const int HB_FRAME_BYTES = 64;
static const int HB_MAGIC = 72;
static const int HB_VERSION = 1;
static const int HB_LONGEST_WATCHDOG_MS = 1000;
static const int HB_KIND_STATE = 83;
static const int HB_KIND_SHEET = 68;
static const int HB_KIND_LOOP = 76;
static const int HB_KIND_REPORT = 82;
static const int HB_KIND_LOOP_TURN = 85;
static const int HB_KIND_FORCE = 70;
static const int HB_KIND_ASK = 63;
static const int HB_KIND_SETTING = 71;
static const int HB_KIND_POSE = 84;
static const int HB_KIND_PLANES = 80;
static const int HB_KIND_SHOW = 89;
static const int HB_CAUSE_TEMPERATURE = 64;
static const int HB_CAUSE_ENCODER = 128;
static const int HB_CAUSE_DRIVER = 192;
static const int HB_OPTION_ENABLE = 1;
static const int HB_OPTION_HAS_VELOCITY = 2;
static const int HB_OPTION_IS_PLACED = 4;
static const int HB_OPTION_PLANE = 16;
static const int HB_PLANES = 3;
static const int HB_TRIALS = 8;
static const float HB_NEAR = 0.999999f;
static const float HB_SLOWEST = 0.25f;
static const float HB_LONGEST = 3.0f;
static const float HB_LARGEST_TWIST = 2.5f;
static const float HB_SPEED_STEP = 0.001f;
static const float HB_TURN_STEP = 0.001f;

#endif
