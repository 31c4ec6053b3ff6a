"""Mixers that only the theory needs.

They are QPLEX whose weights see more, or less, than the script's, QPLEX with dueling heads, a QPLEX small enough to
read, and VDN as a mixer. All are called as the mixers of the scripts are.
"""

import numpy as np
import torch
from torch import nn

from avf_qplex import QPLEXMixer
from avf_vdn import mix


def own_actions(sizes):
    """Which macro-actions each agent has, bool [n, A], for agents that have so many."""
    return torch.arange(max(sizes)) < torch.tensor(sizes)[:, None]


class VDNMixer(nn.Module):
    """The script's sum."""

    def forward(self, utilities, actions, available, state):
        return mix(utilities, actions)


class ToldAvailable(QPLEXMixer):
    """QPLEX told what is available: all its weights see it beside the state, hence m^- and who is free.

    It is fixed while agents choose, so Mac-IGM is not touched.
    """

    def __init__(self, own_actions, state_size, *args, **options):
        super().__init__(own_actions, state_size + own_actions.numel(), *args, **options)

    def forward(self, utilities, actions, available, state):
        seen = torch.cat([state, available.flatten(-2)], -1)
        return super().forward(utilities, actions, available, seen)


class ToldB(QPLEXMixer):
    """QPLEX of which the b_i alone see what is available. Only their sum matters, so it is a network of its own."""

    def __init__(self, own_actions, state_size, hidden=128, **options):
        super().__init__(own_actions, state_size, hidden, **options)
        inputs = state_size + own_actions.numel()
        self.bias_net = nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, 1))

    def forward(self, utilities, actions, available, state):
        seen = torch.cat([state, available.flatten(-2)], -1)
        return super().forward(utilities, actions, available, state) + self.bias_net(seen)[..., 0]


class ToldLambda(ToldAvailable):
    """QPLEX of which the lambda_i alone see what is available: w_i and b_i are functions of the state."""

    def __init__(self, own_actions, state_size, *args, **options):
        super().__init__(own_actions, state_size, *args, **options)
        self.state_net = TwoViews(self.state_net, state_size, 2 * len(own_actions))


class Dueling(QPLEXMixer):
    """QPLEX with dueling heads (Def. 3.3): V_i is free, so that advantages may have any sign.

    Utilities are [..., n, A + 1]: the last column is V_i, which is no macro-action. The script's formula takes V_i to
    be the best of `choices`, which is this column alone.
    """

    def __init__(self, own_actions, state_size, *args, **options):
        n_agents, n_actions = own_actions.shape
        value_alone = torch.arange(n_actions + 1) == n_actions
        super().__init__(value_alone.repeat(n_agents, 1), state_size, *args, mask_ongoing=False, **options)


class FirstInputs(nn.Module):
    """Sets all but the first so many inputs to 0."""

    def __init__(self, count):
        super().__init__()
        self.count = count

    def forward(self, inputs):
        place = torch.arange(inputs.shape[-1])
        return torch.where(place < self.count, inputs, 0.0)


class TwoViews(nn.Module):
    """A network whose first outputs see the first inputs alone, and whose other outputs see all inputs."""

    def __init__(self, net, first_inputs, first_outputs):
        super().__init__()
        self.net = net
        self.narrow = FirstInputs(first_inputs)
        self.first_outputs = first_outputs

    def forward(self, inputs):
        narrow = self.net(self.narrow(inputs))[..., : self.first_outputs]
        wide = self.net(inputs)[..., self.first_outputs :]
        return torch.cat([narrow, wide], -1)


def with_lambda_of_state(mixer):
    """The QPLEX mixer with lambda_i(s): its lambdas no longer see the joint macro-action."""
    state_size = mixer.state_net[0].in_features
    mixer.action_net = nn.Sequential(FirstInputs(state_size), *mixer.action_net)
    return mixer


def two_by_two(**options):
    """A QPLEX network small enough to read, for 2 agents with macro-actions a, b and a state of width 1.

    w_i = 1, b_i = 0, lambda_i = 8 sigmoid(0) sigmoid(action_i(m)). Hence lambda_1 = 1, and lambda_2 = 3 if agent 1
    takes a, 1 if it takes b. (The script adds 1e-10 to w_i and to the key.)
    """
    mixer = QPLEXMixer(own_actions([2, 2]), 1, hidden=1, heads=1, **options)
    mixer = mixer.double().requires_grad_(False)
    for parameter in mixer.parameters():
        parameter.zero_()
    log3 = np.log(3.0)  # sigmoid(log 3) = 3/4, sigmoid(-log 3) = 1/4
    state_bias = [1, 1, 0, 0, 8, 0, 0]  # w_1, w_2, b_1, b_2, key, agent_1, agent_2
    first_weight = [[0, 1, 0, 0, 0]]  # of the state, m_1 = a, m_1 = b, m_2 = a, m_2 = b
    mixer.state_net[-1].bias.copy_(torch.tensor(state_bias))
    mixer.action_net[0].weight.copy_(torch.tensor(first_weight))
    mixer.action_net[-1].weight.copy_(torch.tensor([[0], [2 * log3]]))
    mixer.action_net[-1].bias.copy_(torch.tensor([-log3, -log3]))
    return mixer
