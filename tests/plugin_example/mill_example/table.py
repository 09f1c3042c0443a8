"""A device's table of the rig file, checked."""

from collections.abc import Mapping
from typing import Any, TypeVar

import pydantic

from drivers.errors import ConfigError


class Table(pydantic.BaseModel):
    """Unknown keys are refused."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)


Model = TypeVar("Model", bound=Table)


def checked(model: type[Model], kind: str, table: Mapping[str, Any]) -> Model:
    """The table as its model.

    Raises:
        ConfigError: the first wrong key, and what is allowed.
    """
    try:
        return model.model_validate(table)
    except pydantic.ValidationError as error:
        first = error.errors(include_url=False)[0]
        key, allowed = ".".join(map(str, first["loc"])), ", ".join(model.model_fields)
        raise ConfigError(f"[{kind}] {key}: {first['msg']}; correct it; allowed keys: {allowed}") from None
