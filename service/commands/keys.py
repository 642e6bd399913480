"""``camind keys``: who may use the service."""

from datetime import UTC, datetime, timedelta
from typing import Annotated

import typer

from service.commands.failures import WRONG_USE, failure
from service.commands.opened import ready_engine
from service.commands.options import MOST_DAYS
from service.principal import EVERYDAY, SCOPES

app = typer.Typer(help="The API keys: who may use the service.", no_args_is_help=True)


@app.command(name="create")
def create_key(
    name: Annotated[str, typer.Argument(help="What to call it")],
    scope: Annotated[
        list[str] | None, typer.Option(help=f"May be repeated: {', '.join(SCOPES)}. [default: all but admin]")
    ] = None,
    owner: Annotated[
        str | None, typer.Option(help="Whose cameras and calibrations it works with. [default: its name]")
    ] = None,
    days: Annotated[
        float | None, typer.Option(help="How long it is good. [default: for ever]", min=0.0, max=MOST_DAYS)
    ] = None,
) -> None:
    """Make an API key and print it: it is not stored and cannot be shown again."""
    from service.storage.keys import Keys

    scopes = [known for known in SCOPES if known in (scope or EVERYDAY)]
    unknown = sorted(set(scope or ()) - set(scopes))
    if unknown:
        raise failure(f"There is no scope {', '.join(unknown)}: take {', '.join(SCOPES)}.", WRONG_USE)
    expires_at = None if days is None else datetime.now(UTC) + timedelta(days=days)
    with ready_engine() as engine:
        key, text = Keys(engine).create(name, owner or name, scopes, expires_at)
    until = f"until {key.expires_at:%Y-%m-%d %H:%M} UTC" if key.expires_at else "until it is revoked"
    typer.echo(f"Key {key.id} for {key.owner}: {', '.join(scopes)}; good {until}. It is shown this once:", err=True)
    typer.echo(text)


@app.command(name="list")
def list_keys() -> None:
    """Print id, name, owner, scopes, state, expiry and last use, a key a line."""
    from service.storage.keys import ApiKey, Keys

    now = datetime.now(UTC)

    def moment(time: datetime | None) -> str:
        return f"{time:%Y-%m-%d %H:%M}" if time else "never"

    def line(key: ApiKey) -> str:
        state = "good" if key.is_good(now) else "revoked" if key.revoked_at else "expired"
        scopes = ",".join(scope for scope in SCOPES if scope in key.scopes)
        dates = f"expires {moment(key.expires_at)}\tused {moment(key.last_used_at)}"
        return f"{key.id}\t{key.name}\t{key.owner}\t{scopes}\t{state}\t{dates}"

    with ready_engine() as engine:
        for key in Keys(engine).every():
            typer.echo(line(key))


@app.command(name="revoke")
def revoke_key(key_id: Annotated[str, typer.Argument(help="As `camind keys list` shows it")]) -> None:
    """Refuse a key from now on; what it made stays with its owner."""
    from service.storage.keys import Keys

    with ready_engine() as engine:
        key = Keys(engine).revoke(key_id)
    typer.echo(f"Key {key.id} ({key.name}) is refused from now on.")
