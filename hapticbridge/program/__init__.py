"""Another program's side of the device's loop: it needs NumPy alone.

``device_loop`` has the class for the program, ``messages`` what it and the loop tell each other.
The loop itself runs in a process of its own (``hapticbridge serve``), so that the program may live
in an environment with other versions of MuJoCo and NumPy, or on another machine.
"""
