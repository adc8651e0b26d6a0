"""Parameters of the learner, validated when they are built."""

from dataclasses import dataclass, field

from envs.config import check_choice, check_range


@dataclass
class AgentConfig:
    """MADDPG and its independent case DDPG."""

    algorithm: str = "maddpg"
    """maddpg: centralised critics Q_i(s, a_1..a_N). ddpg: independent critics Q_i(o_i, a_i)."""
    actor_cells: list[int] = field(default_factory=lambda: [64, 64])
    """Hidden units of every actor, layer by layer, 1..4096 each."""
    critic_cells: list[int] = field(default_factory=lambda: [64, 64])
    """Hidden units of every critic, layer by layer, 1..4096 each."""
    share_params: bool = False
    """One actor and one critic for all robots instead of one each (true with the command line's agent=maddpg and ddpg)."""
    actor_lr: float = 1e-3
    """Learning rate of the actors (Adam), (0, 1]."""
    critic_lr: float = 1e-3
    """Learning rate of the critics (Adam), (0, 1]."""
    critic_action: str = "auto"
    """Which actions the critics value, and the actors are improved by. nominal: those before the filter, noise included
    (the filter is a part of the environment). executed: those after it (the paper); the critics then know nothing of
    actions that the filter would change, and may draw the actors there. auto: executed with safety.in_loss=true, which
    needs it, else nominal."""
    critic_state: str = "own"
    """State that critic i sees: own (robot i's observation, which holds all places and batteries) | concatenated (all
    observations, the paper)."""
    foresight: int = 5
    """Critics also see the batteries and the coverage cost that this many steps of the actions would lead to, by the
    world's model, 0..1000 (0: the paper)."""
    gamma: float = 0.99
    """Discount per step, [0, 0.999999]."""
    n_steps: int = 5
    """Steps of reward in the critics' target before it bootstraps, 1..1000 (1: the paper)."""
    initial_reward: float = -0.65
    """Reward per step that the critics expect before they learn anything, [-1e6, 1e6]; they start at this / (1 - gamma)."""
    tau: float = 0.01
    """Soft update of the target networks, (0, 1]."""
    gradient: str = "per_agent"
    """per_agent: robot i's actor gradient recomputes only its own action, the others' come from the replay sample (the paper).
    shared: all actions are recomputed and every critic's gradient reaches every actor (TorchRL's stock loss)."""
    minibatch: str = "shared"
    """shared: one minibatch for all robots. per_agent: every robot samples its own (the paper)."""
    noise: str = "ou"
    """Exploration noise, added before the filter: gaussian | ou (Ornstein-Uhlenbeck)."""
    noise_initial: float = 1.0
    """Standard deviation of the noise at the start, share of max_speed, [0, 10]."""
    noise_final: float = 1.0
    """Standard deviation of the noise at the end of the annealing, share of max_speed, [0, 10]."""
    noise_frames: int = 600_000
    """World-steps over which the noise goes linearly to noise_final, >= 0 (0 = noise_final from the start)."""
    noise_spread: float = 1.0
    """The parallel worlds' noise is spread evenly from (1 - noise_spread) times these standard deviations up to them,
    [0, 1] (0: the same in all worlds, the paper)."""
    ou_theta: float = 0.05
    """ou: mean reversion per step, (0, 1]; 1/theta steps go by before the noise points elsewhere."""
    max_grad_norm: float = 0.0
    """Clip the gradient norm of all actors and of all critics to this, >= 0 (0 = off)."""
    correction_penalty: float = 0.0
    """Weight of ||u - u^||^2 / max_speed^2 in the actor loss, >= 0; needs safety.in_loss=true."""

    def __post_init__(self) -> None:
        """Check every field."""
        check_choice("agent.algorithm", self.algorithm, ("maddpg", "ddpg"))
        for name in ("actor_cells", "critic_cells"):
            cells = getattr(self, name)
            if not cells:
                raise ValueError(
                    f"agent.{name}=[] is empty: give the hidden units of at least one layer, such as [64,64]."
                )
            for cell in cells:
                check_range(f"agent.{name}", cell, 1, 4096)
        for name in ("actor_lr", "critic_lr", "tau", "ou_theta"):
            check_range(f"agent.{name}", getattr(self, name), 0, 1, open_low=True)
        check_range("agent.gamma", self.gamma, 0, 0.999999, hint="The discount must be below 1.")
        check_choice("agent.critic_action", self.critic_action, ("auto", "nominal", "executed"))
        check_range("agent.n_steps", self.n_steps, 1, 1000)
        check_range("agent.initial_reward", self.initial_reward, -1e6, 1e6)
        check_choice("agent.critic_state", self.critic_state, ("own", "concatenated"))
        check_range("agent.foresight", self.foresight, 0, 1000)
        check_range("agent.noise_spread", self.noise_spread, 0, 1)
        check_choice("agent.gradient", self.gradient, ("per_agent", "shared"))
        check_choice("agent.minibatch", self.minibatch, ("shared", "per_agent"))
        check_choice("agent.noise", self.noise, ("gaussian", "ou"))
        for name in ("noise_initial", "noise_final"):
            check_range(f"agent.{name}", getattr(self, name), 0, 10)
        check_range("agent.noise_frames", self.noise_frames, 0, 10**12)
        check_range("agent.max_grad_norm", self.max_grad_norm, 0, 1e6)
        check_range("agent.correction_penalty", self.correction_penalty, 0, 1e6)
