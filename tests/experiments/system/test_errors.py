from experiments.system.errors import print_error


def test_print_error_several_lines_become_one_and_spaces_in_a_name_stay(capsys):
    assert print_error("cannot write\n  to 'my  run':\n\n no space", 1) == 1
    assert capsys.readouterr().err == "sndjax: cannot write to 'my  run': no space\n"
