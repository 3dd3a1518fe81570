"""
DCE written as Stable-Baselines3 writes SAC: modules, ``backward()``, ``.item()`` at every step. A yardstick for speed only,
kept here so that nobody takes it for a second implementation; the agent is ``sb3_dce.OfflineDCE``.
"""

from __future__ import annotations

import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.utils import polyak_update
from torch.nn import functional as F

from sb3_dce.policies import OfflineSACPolicy


class SB3MannerDCE:
    """
    One update of DCE at a time, in the order of the paper, with the networks of the real agent.

    :param policy: networks with their optimizers
    :param buffer: Stable-Baselines3's own replay buffer
    :param batch_size: rows per update
    """

    def __init__(self, policy: OfflineSACPolicy, buffer: ReplayBuffer, batch_size: int) -> None:
        self.policy, self.buffer, self.batch_size = policy, buffer, batch_size
        self.gamma, self.tau, self.expectile, self.beta = 0.99, 0.005, 0.7, 2.0
        self.log_ent_coef = th.zeros(1, requires_grad=True)
        self.ent_coef_optimizer = th.optim.Adam([self.log_ent_coef], lr=3e-4)
        self.target_entropy = -float(policy.action_space.shape[0])
        self.losses: dict[str, list[float]] = {"v": [], "q": [], "pi": [], "alpha": []}

    def train(self, gradient_steps: int) -> None:
        """
        :param gradient_steps: updates
        """
        policy = self.policy
        policy.set_training_mode(True)
        for _ in range(gradient_steps):
            data = self.buffer.sample(self.batch_size)
            s, a, s2 = data.observations, data.actions, data.next_observations

            with th.no_grad():
                target_q = th.min(*policy.critic_target(s, a))
            u = target_q - policy.value_net(s)
            value_loss = (th.abs(self.expectile - (u < 0).float()) * u.pow(2)).mean()
            policy.value_net.optimizer.zero_grad()
            value_loss.backward()
            policy.value_net.optimizer.step()

            a_pi, log_prob = policy.actor.action_log_prob(s)
            log_prob = log_prob.reshape(-1, 1)
            with th.no_grad():
                y = data.rewards + (1 - data.dones) * self.gamma * policy.value_net(s2)
            q_data = policy.critic(s, a)
            q_pi = policy.critic(s, a_pi.detach())
            critic_loss = sum(F.mse_loss(q, y) for q in q_data) + self.beta * sum(q.mean() for q in q_pi)
            policy.critic.optimizer.zero_grad()
            critic_loss.backward()
            policy.critic.optimizer.step()

            ent_coef = self.log_ent_coef.exp().detach()
            actor_loss = (ent_coef * log_prob - th.min(*policy.critic(s, a_pi))).mean()
            policy.actor.optimizer.zero_grad()
            actor_loss.backward()
            policy.actor.optimizer.step()
            alpha_loss = -(self.log_ent_coef * (log_prob + self.target_entropy).detach()).mean()
            self.ent_coef_optimizer.zero_grad()
            alpha_loss.backward()
            self.ent_coef_optimizer.step()
            polyak_update(policy.critic.parameters(), policy.critic_target.parameters(), self.tau)

            for name, loss in zip(self.losses, (value_loss, critic_loss, actor_loss, alpha_loss), strict=True):
                self.losses[name].append(loss.item())
