# == arrays ==
# antennas in rows and columns: places, patterns, polarisation
from warprrf.rf.channel.arrays import PlanarArray as PlanarArray

# yaw, pitch and roll that point an array somewhere
from warprrf.rf.channel.arrays import orientation_towards as orientation_towards

# what taking a spherical wave for a plane one costs
from warprrf.rf.channel.arrays import plane_wave_error as plane_wave_error

# its phases, beam loss and entries
from warprrf.rf.channel.arrays import PlaneWaveError as PlaneWaveError

# angular spectra that small arrays measured, NeRF2's folders among them
from warprrf.rf.channel.array_spectra import ArraySpectra as ArraySpectra

# == beams ==
# beams of an array
from warprrf.rf.channel.beams import Codebook as Codebook

# at equally spaced spatial frequencies
from warprrf.rf.channel.beams import dft_codebook as dft_codebook

# towards directions, or focused on points
from warprrf.rf.channel.beams import steering_codebook as steering_codebook

# predicted mean gain of every pair
from warprrf.rf.channel.beams import beam_gains as beam_gains

# the best pairs, without pilots
from warprrf.rf.channel.beams import select_beams as select_beams

# what `select_beams` found
from warprrf.rf.channel.beams import BeamChoice as BeamChoice

# one pair for each of several users at once
from warprrf.rf.channel.beams import select_beams_multiuser as select_beams_multiuser

# what `select_beams_multiuser` found
from warprrf.rf.channel.beams import MultiUserChoice as MultiUserChoice

# SINR of users, given the gains of their beams
from warprrf.rf.channel.beams import signal_over_interference as signal_over_interference

# == precoders ==
# maximum ratio, zero forcing, signal over leakage and noise
from warprrf.rf.channel.precoding import precoders as precoders

# what each user then gets
from warprrf.rf.channel.precoding import precoded_sinr as precoded_sinr

# mean covariance of users' channels, from paths or spectra
from warprrf.rf.channel.precoding import transmit_covariance as transmit_covariance

# == spreads ==
# delay and angular spreads, K-factor, coherence bandwidth
from warprrf.rf.channel.dispersion import Dispersion as Dispersion

# mean delay and rms delay spread of powers
from warprrf.rf.channel.dispersion import delay_spread as delay_spread

# of powers over an angle
from warprrf.rf.channel.dispersion import angular_spread as angular_spread

# of powers over delays
from warprrf.rf.channel.dispersion import coherence_bandwidth as coherence_bandwidth

# == channels of IEEE Std 802.15.3d ==
# the channel of a number
from warprrf.rf.channel.band_plan import thz_channel as thz_channel

# its edges, centre, bandwidth and frequencies
from warprrf.rf.channel.band_plan import ThzChannel as ThzChannel

# all of them
from warprrf.rf.channel.band_plan import THZ_CHANNELS as THZ_CHANNELS
