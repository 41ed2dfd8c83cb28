"""Robot profiles: joints, limits, torque limits, and the meaning of the effort field of a recording."""

from lipcore.profiles.catalogue import names, profile, profiles, recognise
from lipcore.profiles.profile import Profile, from_urdf
from lipcore.vocabulary import EffortMeaning

__all__ = ["EffortMeaning", "Profile", "from_urdf", "names", "profile", "profiles", "recognise"]
