"""Predict the return of a policy from its weights, on runs of other seeds.

python examples/predict_return_from_weights.py

The features do not depend on the order of hidden units, which differs from run to run.
"""

import numpy as np
import torch

import weighttraj as wt


def examples(split):
    """Return features and mean returns of the evaluated snapshots."""
    features, returns = [], []
    for run in wt.open("inverted-pendulum-v4-ppo-v1").split(split):
        mean = run.mean_return(deterministic=False)
        known = np.isfinite(mean)  # not every snapshot is evaluated
        tensors = list(run.layout.unflatten(run.weights[:][known]).values())
        first, second, last = (tensor for tensor in tensors if tensor.ndim == 3)
        product = (last @ second @ first)[:, 0]  # (snapshot, observation)
        norms = [np.linalg.norm(each.reshape(len(product), -1), axis=1) for each in tensors]
        features.append(np.column_stack([product, *norms]))
        returns.append(mean[known] / 1_000)  # the largest return of this task is 1,000
    return torch.tensor(np.concatenate(features)).float(), torch.tensor(np.concatenate(returns))


(x, y), (x_test, y_test) = examples("train"), examples("test")
mean, scale = x.mean(0), x.std(0)
torch.manual_seed(0)
net = torch.nn.Sequential(torch.nn.Linear(x.shape[1], 64), torch.nn.ReLU(), torch.nn.Linear(64, 1))
optimizer = torch.optim.AdamW(net.parameters(), lr=1e-3)
for rows in torch.randint(len(x), (2_000, 64)):
    net.zero_grad()
    (net((x[rows] - mean) / scale)[:, 0] - y[rows]).square().mean().backward()
    optimizer.step()
error = (net((x_test - mean) / scale)[:, 0] - y_test).square().mean() / y_test.var()
print(f"explained variance on test runs: {1 - error.item():.2f}")
