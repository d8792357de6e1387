"""Physics engines behind one small interface: ``init``, ``kinematics`` and ``step``."""
