"""The method "none": no shadows, in harmonics as by log-SH."""

from warpshadow.pipeline.methods.log_sh import LogSH


class NoShadows(LogSH):
    """Light without visibility; no body has spheres."""

    traces_self_visibility = False
    why_no_shadows = "the method is to have no shadows"


METHOD = NoShadows
