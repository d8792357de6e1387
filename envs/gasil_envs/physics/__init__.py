"""Physics engines behind one small interface: ``init(qpos, qvel)`` and ``step``."""
