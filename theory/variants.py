"""Mixers that only the theory needs: QPLEX whose weights see more, or less, than the script's, a QPLEX small enough to
read, and VDN as a mixer."""

import numpy as np
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


def two_by_two(**options):
    """A QPLEX network small enough to read, for 2 agents with macro-actions a, b and a state of width 1.

    w_i = 1, b_i = 0, lambda_i = 8 sigmoid(0) sigmoid(action_i(m)), hence lambda_1 = 1, and lambda_2 = 3 if agent 1
    takes a, 1 if it takes b. (1e-10 is added to w_i.)
    """
    mixer = QPLEXMixer([2, 2], 1, embed=1, heads=1, **options).double().requires_grad_(False)
    for parameter in mixer.parameters():
        parameter.zero_()
    log3 = np.log(3.0)  # sigmoid(log 3) = 3/4, sigmoid(-log 3) = 1/4
    mixer.of_state[-1].bias.copy_(torch.tensor([1, 1, 0, 0, 8, 0, 0]))  # w_1, w_2, b_1, b_2, key, agent_1, agent_2
    mixer.of_action[0].weight.copy_(torch.tensor([[0, 1, 0, 0, 0]]))  # of state, m_1 = a, m_1 = b, m_2 = a, m_2 = b
    mixer.of_action[-1].weight.copy_(torch.tensor([[0], [2 * log3]]))
    mixer.of_action[-1].bias.copy_(torch.tensor([-log3, -log3]))
    return mixer
