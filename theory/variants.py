"""Mixers that only the theory needs: QPLEX whose weights see more, or less, than the script's, and VDN as a mixer."""

import torch
from torch import nn

from avf_qplex import QPLEXMixer
from avf_vdn import mix


class VDNMixer(nn.Module):
    """The script's sum, called as the other mixers are."""

    def forward(self, utilities, values, actions, chosen, state):
        return mix(utilities)


class SeeOngoing(QPLEXMixer):
    """Told m^-: the weights see, beside the state, the macro-actions of ongoing agents, one-hot, zeros for the others.

    They are fixed while the others choose, so Mac-IGM is not touched.
    """

    def __init__(self, n_actions, state_size, *args, **options):
        super().__init__(n_actions, state_size + len(n_actions) * max(n_actions), *args, **options)
        self.widest = max(n_actions)

    def forward(self, utilities, values, actions, chosen, state):
        ongoing = nn.functional.one_hot(actions, self.widest) * ~chosen[..., None]  # [..., n, A]
        return super().forward(utilities, values, actions, chosen, torch.cat([state, ongoing.flatten(-2)], -1))


class StateOnly(QPLEXMixer):
    """lambda_i(s): takes every joint macro-action for the same one, so that advantages may have any sign (dueling)."""

    def forward(self, utilities, values, actions, chosen, state):
        return super().forward(utilities, values, torch.zeros_like(actions), chosen, state)
