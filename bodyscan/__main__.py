from bodyscan.cli import main

main()
