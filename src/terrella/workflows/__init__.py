"""What a person does over several rooms: learn, practise, plan, evaluate, transfer, score, collect.

Each is a plain function with one frozen config and one frozen result, which the command line parses and prints.
"""
