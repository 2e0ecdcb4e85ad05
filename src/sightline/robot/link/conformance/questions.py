"""The table of all questions that move nothing, in the order of the test."""

from sightline.robot.link.conformance import clients, commands, messages, poses, stops
from sightline.robot.link.conformance.asking import Question

QUESTIONS: dict[str, Question] = {
    **commands.QUESTIONS,
    **poses.QUESTIONS,
    **stops.STOPS,
    **messages.QUESTIONS,
    **clients.QUESTIONS,
    **stops.EMERGENCIES,
}
