"""Topics of messages, and where messages go: into a file, or to who listens."""

from __future__ import annotations

from typing import IO, Any, NamedTuple, Protocol

from apcc_torch.errors import ConfigError
from apcc_torch.hardware.log_format import Layout
from apcc_torch.messages.foxglove_library import foxglove


class Topic(NamedTuple):
    """A topic with its schema, as MCAP and Foxglove's websocket have it.

    name: Such as /tf. encoding: Of its messages. schema: Name of their type. described: How the schema is written.
    description: The schema.
    """

    name: str
    encoding: str
    schema: str
    described: str
    description: bytes

    @classmethod
    def numbers(cls, layout: Layout, prefix: str = "") -> Topic:
        """Of messages as logs have them: CDR, described by a ROS 2 message definition."""
        return cls(prefix + layout.topic, "cdr", layout.schema_name, "ros2msg", layout.definition.encode())

    @classmethod
    def well_known(cls, name: str, kind: Any) -> Topic:
        """Of messages of a class of foxglove's, which brings its schema."""
        schema = kind.get_schema()
        return cls(name, "protobuf", schema.name, schema.encoding, schema.data)


class Sink(Protocol):
    """Where messages go."""

    def add(self, topic: Topic, content: bytes, logged: int, published: int) -> None:
        """Takes a message; both stamps are ns since 1970."""


class FileSink:
    """An MCAP file, good for `with`, which ends it.

    Raises:
        ConfigError: mcap is not installed.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        try:
            from mcap.writer import Writer
        except ImportError as error:
            raise ConfigError("MCAP files need mcap: pip install 'apcc-torch[foxglove]'") from error
        self.writer = Writer(stream)
        self.channels: dict[Topic, int] = {}

    def __enter__(self) -> FileSink:
        self.writer.start(library="apcc_torch")
        return self

    def __exit__(self, *unused: object) -> None:
        self.writer.finish()

    def add(self, topic: Topic, content: bytes, logged: int, published: int) -> None:
        """See `Sink.add`."""
        if topic not in self.channels:
            schema = self.writer.register_schema(topic.schema, topic.described, topic.description)
            self.channels[topic] = self.writer.register_channel(topic.name, topic.encoding, schema)
        self.writer.add_message(self.channels[topic], logged, content, published)


class ServerSink:
    """The clients of a server of foxglove's.

    Args:
        context: The server's.
    """

    def __init__(self, context: Any) -> None:
        self.context = context
        self.channels: dict[Topic, Any] = {}

    def advertise(self, topic: Topic) -> None:
        """Tells clients of a topic before its first message."""
        if topic not in self.channels:
            library = foxglove()
            schema = library.Schema(name=topic.schema, encoding=topic.described, data=topic.description)
            self.channels[topic] = library.Channel(
                topic.name, schema=schema, message_encoding=topic.encoding, context=self.context
            )

    def add(self, topic: Topic, content: bytes, logged: int, published: int) -> None:
        """See `Sink.add`; clients are told when a message was logged alone."""
        self.advertise(topic)
        self.channels[topic].log(content, log_time=logged)
