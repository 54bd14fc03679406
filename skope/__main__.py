from skope.cli import main

main()
