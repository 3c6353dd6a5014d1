from ae_env.scorers import list_scorers


def test_all_scorers_are_listed(ae_env) -> None:
    code, out, _ = ae_env("scorers")
    assert code == 0
    for name in list_scorers():
        assert any(line.split()[:1] == [name] for line in out.splitlines()), name
    assert "Needs extra cv" in out
    assert "AE_ENV_NIMA_AESTHETIC" in out
