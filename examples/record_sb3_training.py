"""Record the weights of a Stable-Baselines3 training, and play a recorded policy again.

python examples/record_sb3_training.py
"""

from pathlib import Path

from stable_baselines3 import PPO

import weighttraj as wt
from weighttraj.collect import WeightTrajectoryCallback
from weighttraj.policies import evaluate, load_policies

OUT = Path("data/examples/cartpole.zarr")

# Train as usual. The callback takes a snapshot of the weights every 32 gradient steps.
model = PPO("MlpPolicy", "CartPole-v1", n_steps=512, n_epochs=4, seed=0, device="cpu")
with WeightTrajectoryCallback(OUT, every=32) as callback:
    model.learn(4_096, callback=callback)

# The run holds one row for each snapshot.
run = wt.open_run(OUT)
print(run)
print("weights:", run.weights.shape, "(snapshot, parameter)")
print("environment steps:", run.num_timesteps[[0, -1]])

# Every snapshot is a policy that acts: here the first one and the last one.
returns = evaluate(load_policies(run, [0, -1]), run, episodes=10, deterministic=False).returns
print("mean return, first and last snapshot:", returns.mean(axis=1))
