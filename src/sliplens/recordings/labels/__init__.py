"""Labels from force samples and frames: axes, lag, friction, safety margins with uncertainty, the reference frame."""
