"""Point-line visual-inertial SLAM for ROS 2."""
import os

# The matrices here are small: a second BLAS thread only spins, and takes the core from the node's other threads.
# NumPy reads this when it is first imported; what the user has set stays.
for _threads in ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS'):
    os.environ.setdefault(_threads, '1')
