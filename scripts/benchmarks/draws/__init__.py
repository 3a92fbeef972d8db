"""Limbs with numbers drawn at random: does a calibration, learning or feedback fail on any?"""
