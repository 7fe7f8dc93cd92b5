"""Have PPO choose what a learner watches: pip install 'cdmisfa[rl]', python examples/ppo.py."""

from stable_baselines3 import PPO

from cdmisfa import OscillatorySource, WatchEnv

env = WatchEnv(OscillatorySource(), observe="outputs", max_iterations=200)
agent = PPO("MlpPolicy", env, n_steps=200, batch_size=50, seed=0, verbose=1)
agent.learn(2000)

for name in ("PPO", "the learner"):
    seen, info = env.reset(seed=0)
    total, over = 0.0, False
    while not over:
        action = agent.predict(seen)[0] if name == "PPO" else info["stream"]
        seen, reward, terminated, truncated, info = env.step(action)
        total, over = total + reward, terminated or truncated
    learned = [module.stream for module in env.learner.modules]
    print(f"{name}: reward {total:.2f}, learned {learned}")
