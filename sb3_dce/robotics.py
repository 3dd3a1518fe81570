"""
What Gymnasium-Robotics' Adroit and Kitchen environments lack to be D4RL's, as wrappers.

The package itself is imported by the functions that need it only. Its reward change is described in
Farama-Foundation/Gymnasium-Robotics#220; the constants are those of D4RL, which Gymnasium-Robotics shares.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs

# first release that pays the distance to the object in the Adroit "-v1" environments instead of charging it
_SIGN_ERROR_SINCE = (1, 2, 1)
_PEN_DROPPED_BELOW = 0.075
_KITCHEN_GOAL_SIZE = 30
# D4RL's joint noise (about 0.01 rad); Gymnasium-Robotics uses a tenth of it
KITCHEN_ROBOT_NOISE_RATIO = 0.1


class AdroitRewardFix(gym.Wrapper, RecordConstructorArgs):
    """
    Charge the distance from palm to object, as D4RL does: ``r - 0.2 * ||palm - object||``.

    Door, Hammer and Relocate of Gymnasium-Robotics >= 1.2.1 add ``0.1 * ||palm - object||`` where D4RL subtracts it.

    :param env: one of these three environments, version 1
    """

    def __init__(self, env: gym.Env) -> None:
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        Step the simulator, and take ``0.2 * ||palm - object||`` off its reward.

        :param action: shape (act_dim,)
        :return: observation, corrected reward, terminated, truncated, info
        """
        obs, reward, terminated, truncated, info = self.env.step(action)
        return obs, float(reward) - 0.2 * self._distance(), terminated, truncated, info

    def _distance(self) -> float:
        simulator: Any = self.unwrapped
        data = simulator.data
        if hasattr(simulator, "handle_site_id"):
            offset = data.site_xpos[simulator.grasp_site_id] - data.site_xpos[simulator.handle_site_id]
        else:
            offset = data.site_xpos[simulator.S_grasp_site_id] - data.xpos[simulator.obj_body_id]
        return float(np.linalg.norm(offset))


class PenTermination(gym.Wrapper, RecordConstructorArgs):
    """
    End the episode when the pen has been dropped, as D4RL does; Gymnasium-Robotics never ends it.

    :param env: the Adroit pen environment
    """

    def __init__(self, env: gym.Env) -> None:
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        Step the simulator, and end the episode once the pen is below 0.075 m.

        :param action: shape (act_dim,)
        :return: observation, reward, whether the pen lies too low, truncated, info
        """
        obs, reward, _, truncated, info = self.env.step(action)
        simulator: Any = self.unwrapped
        dropped = bool(simulator.data.xpos[simulator.obj_body_id][2] < _PEN_DROPPED_BELOW)
        return obs, float(reward), dropped, truncated, info


class KitchenObservation(gym.ObservationWrapper, RecordConstructorArgs):
    """
    D4RL's 60 observations: 9 robot positions, 21 object positions, 30 goal entries (zero but for the target tasks).

    Actions are declared float32 instead of float64, as in the other environments and in the data.

    :param env: ``FrankaKitchen``, whose observation is a dictionary with 59 entries and goals
    """

    def __init__(self, env: gym.Env) -> None:
        from gymnasium_robotics.envs.franka_kitchen.kitchen_env import OBS_ELEMENT_INDICES

        RecordConstructorArgs.__init__(self)
        gym.ObservationWrapper.__init__(self, env)
        simulator: Any = self.unwrapped
        self.goal = np.zeros(_KITCHEN_GOAL_SIZE)
        for task, goal in simulator.goal.items():
            self.goal[OBS_ELEMENT_INDICES[task]] = goal
        self.observation_space = spaces.Box(-np.inf, np.inf, (60,), np.float64)
        self.action_space = spaces.Box(-1.0, 1.0, simulator.action_space.shape, np.float32)

    def observation(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """
        Make D4RL's observation of the simulator's: all velocities are left out, the goal is appended.

        :param observation: "observation" holds robot positions 9, robot velocities 9, object positions 21, velocities 20
        :return: shape (60,)
        """
        state = observation["observation"]
        return np.concatenate([state[:9], state[18:39], self.goal])


def fix_adroit(env: gym.Env) -> gym.Env:
    """
    Give an Adroit environment of Gymnasium-Robotics the reward and the episode end of D4RL.

    :param env: the simulator itself, without wrappers
    :return: the environment to evaluate in
    """
    from gymnasium_robotics import __version__
    from gymnasium_robotics.envs.adroit_hand.adroit_pen import AdroitHandPenEnv

    if isinstance(env, AdroitHandPenEnv):
        return PenTermination(env)
    numbers = tuple(int(part) for part in __version__.split(".")[:3] if part.isdigit())
    return AdroitRewardFix(env) if numbers >= _SIGN_ERROR_SINCE else env


def kitchen_tasks(dataset_id: str) -> list[str]:
    """
    The four tasks that pay reward in a kitchen dataset: ``mixed`` sets have the burner in place of the cabinet.

    :param dataset_id: id of a kitchen dataset
    :return: their names in Gymnasium-Robotics
    """
    last_two = ["bottom burner", "light switch"] if "mixed" in dataset_id else ["light switch", "slide cabinet"]
    return ["microwave", "kettle", *last_two]


def fix_kitchen_joint_types() -> None:
    """
    Make Gymnasium-Robotics recognise the joint types of MuJoCo >= 3.12.

    Its helpers look for a NumPy integer in a tuple of enumeration members, which has been false since then, so that
    ``FrankaKitchen`` fails at reset. They are replaced only if a probe on a one-joint model shows the fault.
    """
    import mujoco
    from gymnasium_robotics.utils import mujoco_utils

    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="hinge"/><geom size="1"/></body></worldbody></mujoco>'
    )
    try:
        mujoco_utils.get_joint_qpos(model, mujoco.MjData(model), "hinge")
    except AssertionError:
        for name in ("qpos", "qvel"):
            setattr(mujoco_utils, f"get_joint_{name}", _joint_reader(name))
            setattr(mujoco_utils, f"set_joint_{name}", _joint_writer(name))


def _joint_slice(model: Any, quantity: str, name: str) -> slice:
    """Entries of the named joint in ``data.qpos`` (free joint 7, ball 4) or ``data.qvel`` (6 and 3); else 1."""
    import mujoco

    joint = model.joint(name)
    kind = int(joint.type[0])
    widths = {int(mujoco.mjtJoint.mjJNT_FREE): (7, 6), int(mujoco.mjtJoint.mjJNT_BALL): (4, 3)}.get(kind, (1, 1))
    start, width = (joint.qposadr[0], widths[0]) if quantity == "qpos" else (joint.dofadr[0], widths[1])
    return slice(start, start + width)


def _joint_reader(quantity: str) -> Any:
    def read(model: Any, data: Any, name: str) -> np.ndarray:
        return getattr(data, quantity)[_joint_slice(model, quantity, name)].copy()

    return read


def _joint_writer(quantity: str) -> Any:
    def write(model: Any, data: Any, name: str, value: Any) -> None:
        getattr(data, quantity)[_joint_slice(model, quantity, name)] = value

    return write
