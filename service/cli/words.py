"""Names that help and completion list, without the seconds that importing what defines them takes; a test compares.

Other names are in `lipcore.vocabulary`.
"""

ROBOTS = [
    *("panda", "ur3", "ur5", "ur10", "xarm7", "kinova", "z1", "so100", "so101", "baxter-left", "baxter-right"),
    *("pr2-left", "pr2-right", "talos-left", "tiago", "tiago-pro-left", "tiago-pro-right", "double-pendulum"),
    *("asr-twodof", "finger-edu"),
]
HELD_OUT_BY = ["last", "episodes", "blocks"]
