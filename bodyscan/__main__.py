from bodyscan.cli.main import main

main()
