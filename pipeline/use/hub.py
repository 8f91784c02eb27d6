"""Trained models on the Hugging Face Hub: a folder of models/ as a repository, which hf://USER/NAME names."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from huggingface_hub import create_repo, get_token, is_offline_mode, model_info, snapshot_download, upload_folder
from huggingface_hub.errors import HfHubHTTPError, LocalEntryNotFoundError

from pipeline.running.errors import UserError
from pipeline.training.card import CARD_FILE
from pipeline.use.folder import BASE_DIR, CONFIG, read_folder
from pipeline.weights import first_words

HUB = "hf://"


def download(name: str, revision: str | None = None) -> Path:
    """The folder in the Hub's cache of "hf://USER/NAME[@REVISION]"; UserError where neither Hub nor cache gives it."""
    repository, _, tag = name.removeprefix(HUB).partition("@")
    with _asking(name, "there is no such model or revision, or it is not yours to read (`hf auth login`)"):
        return Path(snapshot_download(repository, revision=revision or tag or None))


def files_of(folder: Path) -> list[str]:
    """What of a folder goes to the Hub, once `read_folder` has checked it: the model, its card, and a base within."""
    config, _ = read_folder(folder)
    found = [f.relative_to(folder).as_posix() for f in sorted(folder.rglob("*")) if f.is_file()]
    return [n for n in found if n in {CONFIG, CARD_FILE, *config.files} or n.startswith(f"{BASE_DIR}/")]


def upload(folder: Path, name: str, *, private: bool = False) -> None:
    """Make the repository USER/NAME hold what a folder holds, and nothing else.

    Raises:
        UserError: as `read_folder`; without a token, right to write or network; where `private` is public already.
    """
    files = files_of(folder)
    if get_token() is None:
        raise UserError(f"{name}: there is no token; log in with `hf auth login`, or set HF_TOKEN")
    with _asking(name, "this token may not write there; take one that may (`hf auth login`, or HF_TOKEN)"):
        create_repo(name, private=private or None, exist_ok=True)
        if private and not model_info(name).private:
            raise UserError(f"{name}: is there already, and public; make it private on the Hub, or name another")
        # What an earlier model left there, such as an adapter, would be read as this one's.
        upload_folder(repo_id=name, folder_path=folder, allow_patterns=files, delete_patterns="*")


@contextmanager
def _asking(name: str, refused: str) -> Iterator[None]:
    """Say in one line why the Hub did not do what it was asked."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # What a connection raises differs between versions of huggingface_hub.
        # The first tells what happened in many lines, and is caused by it.
        cause = (error.__cause__ or error) if isinstance(error, LocalEntryNotFoundError) else error
        if is_offline_mode():
            reason = "HF_HUB_OFFLINE is set, so only what is whole in the cache can be had; unset it"
        elif isinstance(cause, HfHubHTTPError) and cause.response.status_code in (401, 403, 404):
            reason = refused
        else:
            reason = f"the Hub does not do it ({first_words(cause)}); mend this, or try again later"
        raise UserError(f"{name}: {reason}") from None
