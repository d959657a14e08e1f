"""Errors a user can act on: each says what was found, what was expected and what to do."""


class CbeError(Exception):
    """Base of every error this project raises on bad input or a failed peer."""


class ConfigError(CbeError):
    """A configuration value or command-line option is missing or out of range."""


class MessageError(CbeError):
    """A message is truncated, malformed or holds values its type forbids."""


class LinkError(CbeError):
    """The Zenoh link cannot be opened or a peer does not answer."""


class CameraError(CbeError):
    """A camera model is unusable or an image does not fit it."""


class ModelError(CbeError):
    """An ONNX model is missing, damaged or does not match the signature."""


class RouteError(CbeError):
    """A route file is missing, damaged or was made for another model."""


class RecordingError(CbeError):
    """A recording (MCAP) is missing, damaged or lacks a needed topic."""


class WorldError(CbeError):
    """A world, floor plan or scene cannot be loaded or used."""
