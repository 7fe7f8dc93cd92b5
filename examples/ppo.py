"""Train PPO (stable-baselines3) to choose the stream that a learner attends to.

Install the extra and run it: pip install -e '.[rl]', then python examples/ppo.py. It prints the
reward and the learned streams of PPO and of the learner's own choice.
"""

from stable_baselines3 import PPO

from cdmisfa import OscillatorySource, WatchEnv

env = WatchEnv(OscillatorySource(), observe="outputs", max_iterations=200)
agent = PPO("MlpPolicy", env, n_steps=200, batch_size=50, seed=0, verbose=1)
agent.learn(2000)

for name in ("PPO", "the learner"):
    observation, info = env.reset(seed=0)
    total, done = 0.0, False
    while not done:
        action = agent.predict(observation)[0] if name == "PPO" else info["stream"]
        observation, reward, terminated, truncated, info = env.step(action)
        total, done = total + reward, terminated or truncated
    learned = [module.stream for module in env.learner.modules]
    print(f"{name}: reward {total:.2f}, learned {learned}")
