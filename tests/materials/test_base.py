"""The registry of materials."""

from warp_neumat.io.asset import KINDS as STORED
from warp_neumat.io.shared_asset import GROUP
from warp_neumat.materials.base import KINDS as OPENED


def test_every_kind_that_can_be_stored_can_be_opened():
    assert set(STORED) == {*OPENED, GROUP}  # a group is no material
