"""Policies that Terrella learned by imitation, as policies of LeRobot of the type `terrella`."""

from .configuration_terrella import TerrellaConfig
from .modeling_terrella import TerrellaPolicy
from .processor_terrella import make_terrella_pre_post_processors

__all__ = ["TerrellaConfig", "TerrellaPolicy", "make_terrella_pre_post_processors"]
