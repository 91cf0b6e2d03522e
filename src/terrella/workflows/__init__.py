"""What a person does over several rooms: learn, practise, plan, evaluate, transfer, score, collect.

Each is a plain function with one frozen config and one frozen result. `import terrella` fetches them lazily, and the command
line parses their configs and prints their results.
"""
